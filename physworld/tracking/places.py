"""From places in a picture to places in space: depth of the patch around each, and whether a point goes with its
neighbours.

Whoever found the places in the picture, our tracker or another one, this is the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.tracking.depth import patch_depth
from physworld.tracking.neighbours import nearest, rigid_misfit
from physworld.tracking.view import back_project

LEAST_POINTS = 4


@dataclass(frozen=True)
class TrackConfig:
    """How points are chosen and followed.

    Attributes:
        points: wanted in one camera.
        patch_px: half the side of a patch.
        depth_px: half the side of the part of it whose depth counts.
        neighbours: that a point is compared with.
        least_correlation: of the patch of the first frame with where it is found.
        backward_px: how far the check backwards may miss.
        misfit_sigmas: how far a point may be from its neighbours' rigid motion, in robust deviations of all.
        least_misfit_m: below which nobody is left out.
        least_area: of a patch, turned away, over its area in the first frame.
        rediscover_below: share of points seen from which the whole picture is searched for the others.
        told_below: share from which points are sought where other cameras put them.
    """

    points: int = 150
    patch_px: int = 9
    depth_px: int = 5
    neighbours: int = 10
    least_correlation: float = 0.75
    backward_px: float = 1.0
    misfit_sigmas: float = 4.0
    least_misfit_m: float = 2e-3
    least_area: float = 0.2
    rediscover_below: float = 0.25
    told_below: float = 0.5


@dataclass(frozen=True)
class Tracks:
    """Points of one camera.

    Attributes:
        points: [m], (T, N, 3); where not visible, where the neighbours put it, or nan.
        visible: (T, N) bool.
        pixels: (T, N, 2).
        colours: of the first frame, (N, 3) uint8.
    """

    points: Array
    visible: Array
    pixels: Array
    colours: Array


class FirstPlaces:
    """Depth of points in the first frame.

    Args:
        camera: whose picture it is.
        mask: the object, (H, W) bool.
        depth: (H, W) [m], 0: none.
        pixels: (N, 2).
        radius: half the side of the part of a patch whose depth counts [px].

    Attributes:
        camera: whose picture it is.
        pixels: (N, 2).
        offsets: of the pixels of a patch that count, (P, 2).
        inside: which of them are on the object, (N, P) bool.
        distance: along the axis [m], nan where too few have depth, (N,).
    """

    def __init__(self, camera: Camera, mask: Array, depth: Array, pixels: Array, radius: int) -> None:
        side = np.arange(-radius, radius + 1)
        self.camera, self.pixels = camera, pixels
        self.offsets = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2).astype(np.float64)
        at = np.floor(pixels[:, None] + self.offsets).astype(int)
        height, width = mask.shape
        within = ((at >= 0) & (at < [width, height])).all(axis=2)
        self.inside = within & mask[at[..., 1].clip(0, height - 1), at[..., 0].clip(0, width - 1)]
        spread = np.tile(self.offsets, (len(pixels), 1, 1))
        self.distance = patch_depth(depth, pixels, spread, self.inside, np.full(len(pixels), np.nan))


class Places:
    """Points in space, from frame to frame.

    Args:
        start: the first frame.
        kept: which of its points, (N,) bool; all have depth.
        config: how.

    Attributes:
        first: places in the first frame [m], (n, 3).
        neighbours: of every point there, (n, K).
    """

    def __init__(self, start: FirstPlaces, kept: Array, config: TrackConfig) -> None:
        self._camera, self._config, self._offsets = start.camera, config, start.offsets
        self._inside = start.inside[kept]
        self.first = back_project(start.camera, start.pixels[kept], start.distance[kept])
        self.neighbours = nearest(self.first, config.neighbours)

    def at(self, depth: Array, pixels: Array, maps: Array, seen: Array) -> tuple[Array, Array]:
        """Places (n, 3) [m], and which of them are seen, without those that leave their neighbours.

        Args:
            depth: (H, W) [m], 0: none.
            pixels: (n, 2).
            maps: of the patches since the first frame, (n, 2, 2).
            seen: whose place in the picture is known, (n,) bool.
        """
        spread = np.einsum("nij,pj->npi", maps, self._offsets)
        distance = patch_depth(depth, pixels, spread, self._inside, np.full(len(pixels), np.nan))
        seen = seen & np.isfinite(distance)
        points = back_project(self._camera, pixels, np.where(seen, distance, 1.0))
        for _ in range(2):
            misfit, places = rigid_misfit(self.first, points, seen, self.neighbours)
            within = seen & np.isfinite(misfit)
            if not within.any():
                break
            scale = 1.4826 * float(np.median(misfit[within]))
            bound = max(self._config.misfit_sigmas * scale, self._config.least_misfit_m)
            seen = seen & (misfit <= bound)
        return np.where(seen[:, None], points, places), seen
