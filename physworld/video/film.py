"""Frames: to an MP4 film (H.264) in memory, and compared with given frames.

Scores are PSNR, SSIM (Wang et al. 2004), IoU of masks, and LPIPS (``lpips.py``) where a network is given. LPIPS needs a
trained network's weights, which nothing here ships: without one it is "not measured".
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fractions import Fraction

import av
import numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from physworld.arrays import Array

_psnr: Callable[..., float] = peak_signal_noise_ratio  # published without types
_ssim: Callable[..., float] = structural_similarity
NOT_MEASURED = "not measured"
_COVERED = 0.5
_SSIM_WINDOW_PX = 11


@dataclass(frozen=True)
class FrameScores:
    """Means over frames and each frame's own values (T,).

    Attributes:
        psnr_db: infinite where frames are equal.
        ssim: 1 where frames are equal.
        iou: of the masks; None where none were given.
        lpips: mean, or "not measured".
        per_frame: the same by name.
    """

    psnr_db: float
    ssim: float
    iou: float | None
    lpips: float | str
    per_frame: dict[str, Array]


def compare_frames(
    rendered: Array,
    given: Array,
    alpha: Array | None = None,
    masks: Array | None = None,
    lpips: Callable[[Array, Array], float] | None = None,
) -> FrameScores:
    """Compare frame by frame.

    Args:
        rendered, given: (T, H, W, 3), both in [0, 1] or 8 bit.
        alpha: coverage of the rendering, (T, H, W) in [0, 1].
        masks: what belongs to the object in the given frames, (T, H, W) bool; with ``alpha`` or not at all.
        lpips: distance of two pictures (H, W, 3) in [0, 1], or None.

    Raises:
        ValueError: shapes that disagree, no frame, frames smaller than SSIM's window of 11 px, or values that are not
            finite or out of range.
    """
    rendered, given = _unit(rendered, "rendered"), _unit(given, "given")
    if rendered.shape != given.shape:
        raise ValueError(f"rendered frames have shape {rendered.shape}, the given ones {given.shape}")
    if (alpha is None) != (masks is None):
        raise ValueError("an IoU needs both the rendering's coverage and the masks of the given frames")
    if min(given.shape[1:3]) < _SSIM_WINDOW_PX:
        raise ValueError(
            f"frames of {given.shape[1]} x {given.shape[2]} px; SSIM's window is {_SSIM_WINDOW_PX} px"
        )
    scores: dict[str, list[float]] = {"psnr_db": [], "ssim": []}
    for one, other in zip(rendered, given, strict=True):
        equal = np.array_equal(one, other)
        scores["psnr_db"].append(float("inf") if equal else _psnr(other, one, data_range=1.0))
        scores["ssim"].append(
            _ssim(
                other, one, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5,
                use_sample_covariance=False,
            )
        )  # fmt: skip
    if alpha is not None and masks is not None:
        covered, wanted = np.asarray(alpha) >= _COVERED, np.asarray(masks, dtype=bool)
        if covered.shape != given.shape[:3] or wanted.shape != given.shape[:3]:
            raise ValueError(
                f"coverage {covered.shape} and masks {wanted.shape} must be of shape {given.shape[:3]}"
            )
        both, either = (covered & wanted).sum(axis=(1, 2)), (covered | wanted).sum(axis=(1, 2))
        scores["iou"] = list(np.where(either > 0, both / np.maximum(either, 1), 1.0))
    if lpips is not None:
        scores["lpips"] = [float(lpips(one, other)) for one, other in zip(rendered, given, strict=True)]
    per_frame = {name: np.array(values) for name, values in scores.items()}
    return FrameScores(
        psnr_db=float(per_frame["psnr_db"].mean()),
        ssim=float(per_frame["ssim"].mean()),
        iou=float(per_frame["iou"].mean()) if "iou" in per_frame else None,
        lpips=float(per_frame["lpips"].mean()) if "lpips" in per_frame else NOT_MEASURED,
        per_frame=per_frame,
    )


def _unit(frames: Array, name: str) -> Array:
    frames = np.asarray(frames)
    if frames.ndim != 4 or frames.shape[-1] != 3 or not frames.size:
        raise ValueError(f"{name} frames must be of shape (T, H, W, 3), got {frames.shape}")
    unit = frames / 255.0 if frames.dtype == np.uint8 else frames.astype(np.float64)
    if not (np.isfinite(unit).all() and unit.min() >= 0.0 and unit.max() <= 1.0):
        raise ValueError(
            f"{name} frames must lie in [0, 1] or be 8 bit, got {unit.min():.3g} to {unit.max():.3g}"
        )
    return unit


def encode_mp4(frames: Iterable[Array], fps: float) -> bytes:
    """A film of frames (H, W, 3), in [0, 1] or 8 bit; an odd row or column at the edge is left out, as H.264 needs.

    Raises:
        ValueError: no frame, frames of different shapes, or a rate that is not positive.
    """
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"a film's rate must be positive, got {fps} frames a second")
    buffer = io.BytesIO()
    shape: tuple[int, ...] | None = None
    with av.open(buffer, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        stream.pix_fmt = "yuv420p"
        for number, frame in enumerate(frames):
            picture = np.asarray(frame)
            if shape is None:
                shape = picture.shape
                if picture.ndim != 3 or picture.shape[2] != 3 or min(picture.shape[:2]) < 2:
                    raise ValueError(f"a frame must be of shape (H, W, 3), got {picture.shape}")
                stream.height, stream.width = (size - size % 2 for size in picture.shape[:2])
            if picture.shape != shape:
                raise ValueError(f"frame {number} has shape {picture.shape}, the first one {shape}")
            if picture.dtype != np.uint8:
                picture = np.round(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8)
            picture = np.ascontiguousarray(picture[: stream.height, : stream.width])
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if shape is None:
            raise ValueError("a film needs at least one frame")
        film.mux(stream.encode())
    return buffer.getvalue()


def frames_per_second(times: Array) -> float:
    """The rate of frames at ``times`` (T,) [s]: one over their median distance.

    Raises:
        ValueError: fewer than 2 frames or times that do not rise.
    """
    steps = np.diff(np.asarray(times, dtype=np.float64))
    if not len(steps) or not (steps > 0).all():
        raise ValueError(f"a film's {len(times)} times must be at least 2 and rise")
    return float(1.0 / np.median(steps))
