"""Pictures of what was followed in a recording, for people to look at, and what films of its scene need."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.tracking.recording import Followed
from physworld.tracking.view import View
from physworld_scenes.archives import ArchiveLimits, read_arrays

if TYPE_CHECKING:
    from physworld.video import SplatView

LENS = ("width", "height", "fx", "fy", "cx", "cy")
VIEW_LIMITS = ArchiveLimits(total_bytes=1 << 30, ratio=5000.0)


def first_and_last(followed: Followed) -> Array:
    """First and last picture of every camera with the object's pixels (blue) and points: green seen, red not.

    Returns:
        (H, W, 3) uint8, a row a camera.
    """
    from PIL import Image, ImageDraw

    rows = []
    for number, (view, mask) in enumerate(zip(followed.views, followed.masks, strict=True)):
        pictures = []
        for frame in (0, view.frames - 1):
            colour = view.colour(frame).copy()
            if frame == 0 and mask.size:
                colour[mask] = colour[mask] // 2 + np.array([0, 60, 110], dtype=np.uint8)
            picture = Image.fromarray(colour)
            pen = ImageDraw.Draw(picture)
            for point in np.flatnonzero(followed.cameras == number):
                x, y = followed.pixels[frame, point]
                if np.isfinite([x, y]).all():
                    seen = followed.visible[frame, point]
                    pen.ellipse((x - 2, y - 2, x + 2, y + 2), fill="lime" if seen else "red")
            pictures.append(np.asarray(picture))
        rows.append(np.hstack(pictures))
    widest = max(row.shape[1] for row in rows)
    return np.vstack([np.pad(row, ((0, 0), (0, widest - row.shape[1]), (0, 0))) for row in rows])


def write_camera(view: View, path: Path) -> None:
    """The camera as JSON, in the form of ``physworld video --camera``."""
    numbers = {name: getattr(view.camera, name) for name in LENS}
    facts = {**numbers, "world_to_camera": view.camera.world_to_camera.tolist()}
    path.write_text(json.dumps(facts, indent=1) + "\n")


def write_frames(view: View, path: Path) -> None:
    """All pictures as ``frames`` (T, H, W, 3) uint8 of an npz, one by one."""
    shape = (view.frames, view.camera.height, view.camera.width, 3)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("frames.npy", "w", force_zip64=True) as stream:
            header = {"descr": "|u1", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(stream, header)
            for frame in range(view.frames):
                stream.write(np.ascontiguousarray(view.colour(frame)).tobytes())


def splat_views(followed: Followed) -> list[SplatView]:
    """What the cameras that see the object show of it in the first frame: a splat is fitted to them."""
    from physworld.video import SplatView

    return [
        SplatView(view.camera, view.colour(0), mask, view.depth(0))
        for view, mask in zip(followed.views, followed.masks, strict=True)
        if mask.size
    ]


def write_views(views: list[SplatView], path: Path) -> None:
    """Views with depth as an npz of plain numbers."""
    arrays: dict[str, Array] = {}
    for number, view in enumerate(views):
        camera = [*(getattr(view.camera, name) for name in LENS), *view.camera.world_to_camera.ravel()]
        parts = {"camera": np.array(camera), "picture": view.picture, "mask": view.mask, "depth": view.depth}
        arrays |= {f"{name}_{number}": np.asarray(part) for name, part in parts.items()}
    np.savez_compressed(path, allow_pickle=False, **arrays)


def read_views(content: bytes) -> list[SplatView]:
    """The views of ``write_views``.

    Raises:
        ArchiveRefused, KeyError, ValueError: it holds something else.
    """
    from physworld.video import SplatView

    arrays = read_arrays(content, VIEW_LIMITS)
    views = []
    for number in range(sum(name.startswith("camera_") for name in arrays)):
        facts, picture, mask, depth = (
            arrays[f"{name}_{number}"] for name in ("camera", "picture", "mask", "depth")
        )
        width, height, fx, fy, cx, cy = facts[: len(LENS)].tolist()
        camera = Camera(int(width), int(height), fx, fy, cx, cy, facts[len(LENS) :].reshape(4, 4))
        views.append(SplatView(camera, picture, mask, depth))
    return views
