"""What pictures with depth show first, as a cloud in the scene's world: so few points that a page can draw them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physworld.arrays import Array
from physworld.tracking.view import Box, cloud_of
from physworld_scenes.importers.pictures import read_first
from physworld_scenes.importers.upright import upright

MOST_POINTS = 5000
MOST_PIXELS = 12_000_000
"""Of all cameras: more take longer to decode than a look may."""


@dataclass(frozen=True)
class FirstCloud:
    """Pixels of the first pictures that have depth, every n-th of them.

    Attributes:
        places: [m], (P, 3), in the scene's world.
        colours: (P, 3) uint8.
        cameras: number of the camera that saw each, (P,).
        pixels: its column and row there, (P, 2).
        ground: height of the ground that was found [m]; None: none was.
        up: how up was found, in words.
        warnings: what was guessed.
    """

    places: Array
    colours: Array
    cameras: Array
    pixels: Array
    ground: float | None
    up: str
    warnings: list[str]


def first_cloud(
    folder: Path, up: str | None, boxes: Mapping[int, Box], depth_scale: float | None = None
) -> FirstCloud:
    """The cloud of a folder's first frame.

    Args:
        folder: one of the layouts of :mod:`physworld_scenes.importers.pictures`.
        up: axis of the cameras' world that points up; None: as an import finds it.
        boxes: around the object, by camera number: the ground is looked for outside.
        depth_scale: depth values a metre; None: 1000 of whole numbers, 1 of others.

    Raises:
        SceneInvalid: files are missing, damaged or too large.
    """
    warnings: list[str] = []
    recording, ground, how = upright(read_first(folder, depth_scale, MOST_PIXELS), up, boxes, warnings)
    cameras = [view.camera for view in recording.views]
    step = max(1, int(np.ceil(np.sqrt(sum(one.width * one.height for one in cameras) / MOST_POINTS))))
    places, colours, numbers, pixels = [], [], [], []
    for number, view in enumerate(recording.views):
        depth = view.depth(0)
        mask = np.zeros(depth.shape, dtype=bool)
        mask[step // 2 :: step, step // 2 :: step] = True
        seen, at = cloud_of(view.camera, depth, mask)
        known = np.isfinite(seen).all(axis=1)
        seen, at = seen[known], at[known]
        places.append(seen)
        colours.append(view.colour(0)[at[:, 0], at[:, 1]])
        numbers.append(np.full(len(seen), number))
        pixels.append(at[:, ::-1])
    kept = slice(0, MOST_POINTS)  # edges may add a few
    return FirstCloud(
        np.concatenate(places)[kept],
        np.concatenate(colours)[kept],
        np.concatenate(numbers)[kept],
        np.concatenate(pixels)[kept],
        None if ground is None else ground.height,
        how,
        warnings,
    )
