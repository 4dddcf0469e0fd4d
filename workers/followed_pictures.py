"""Pictures of what was followed in a recording, for people to look at, and what films of its scene need."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np

from physworld.arrays import Array
from physworld.tracking.recording import Followed
from physworld.tracking.view import View


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
    numbers = {name: getattr(view.camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
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
