"""Films are read back by a decoder; scores against closed forms."""

from __future__ import annotations

import io

import av
import numpy as np
import pytest

from physworld.video import compare_frames, encode_mp4, frames_per_second


def drifting(frames: int = 12, height: int = 33, width: int = 48) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack(
        [np.stack([0.5 + 0.4 * np.sin((x + 2 * t) / 9), y / height, 0 * x + 0.3], -1) for t in range(frames)]
    )


def test_a_film_is_read_back() -> None:
    frames = drifting()
    content = encode_mp4(frames, 30.0)
    with av.open(io.BytesIO(content)) as film:
        stream = film.streams.video[0]
        assert stream.codec_context.name == "h264" and float(stream.average_rate) == pytest.approx(30.0)
        back = np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]) / 255.0
    assert back.shape == (12, 32, 48, 3)  # an odd row is left out
    assert np.abs(back - frames[:, :32]).mean() < 0.02


def test_films_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        encode_mp4([], 30.0)
    with pytest.raises(ValueError, match="must be positive, got 0"):
        encode_mp4(drifting(), 0.0)
    with pytest.raises(ValueError, match=r"frame 1 has shape \(8, 8, 3\)"):
        encode_mp4([np.zeros((16, 16, 3)), np.zeros((8, 8, 3))], 10.0)
    with pytest.raises(ValueError, match="at least 2 and rise"):
        frames_per_second(np.array([0.0]))
    assert frames_per_second(np.array([0.0, 0.1, 0.2, 0.35])) == pytest.approx(10.0)


def test_scores_of_equal_and_of_shifted_frames() -> None:
    frames = drifting()
    same = compare_frames(frames, frames)
    assert same.psnr_db == float("inf") and same.ssim == pytest.approx(1.0) and same.iou is None
    assert same.lpips == "not measured"
    lighter = compare_frames(frames * 0.9, frames * 0.9 + 0.1)
    assert lighter.psnr_db == pytest.approx(20.0)  # an error of 0.1 everywhere
    assert 0.9 < lighter.ssim < 1.0
    noisy = np.clip(frames + np.random.default_rng(0).normal(0, 0.2, frames.shape), 0, 1)
    assert compare_frames(noisy, frames).ssim < 0.6


def test_the_iou_of_two_squares() -> None:
    frames = np.zeros((1, 20, 20, 3))
    alpha, mask = np.zeros((1, 20, 20)), np.zeros((1, 20, 20), dtype=bool)
    alpha[0, :10, :10], mask[0, :10, 5:15] = 1.0, True
    scores = compare_frames(frames, frames, alpha, mask, lpips=lambda a, b: float(np.abs(a - b).mean()))
    assert scores.iou == pytest.approx(50 / 150) and scores.lpips == 0.0


def test_frames_that_cannot_be_compared_are_refused() -> None:
    frames = drifting()
    with pytest.raises(ValueError, match=r"\(11, 33, 48, 3\)"):
        compare_frames(frames[1:], frames)
    with pytest.raises(ValueError, match="must lie in"):
        compare_frames(frames * np.nan, frames)
    with pytest.raises(ValueError, match="both"):
        compare_frames(frames, frames, masks=np.zeros(frames.shape[:3], dtype=bool))
    with pytest.raises(ValueError, match="window is 11 px"):
        compare_frames(frames[:, :5], frames[:, :5])
