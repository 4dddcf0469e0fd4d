"""Where a fit of a splat begins: Gaussians on the surface that depth or a cloud of points shows, in its colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.errors import SplatNotFitted
from physworld.scene import Scene
from physworld.video.gaussians import SH_DC, Gaussians

SMOOTHED_PX = 2.0
"""Deviation of the window over which depth is averaged before Gaussians are put there."""
STEP_M = 0.02
"""Of depth, over which nothing is averaged."""
DENSEST_PX = 1.5
"""Between Gaussians at the densest."""
WIDENED = 1.02
"""How much the grid is, when it holds too many."""
OPAQUE_LOGIT = 2.0
WIDTH_SHARE = 0.5
"""A Gaussian's deviation, of the distance to its neighbours."""


@dataclass(frozen=True)
class SplatView:
    """A calibrated camera's picture of the object in one state.

    Attributes:
        camera: pinhole, in the world of the splat.
        picture: (H, W, 3) uint8.
        mask: the object's pixels, (H, W) bool; None: the whole picture.
        depth: along the camera's axis, (H, W) [m], 0 where there is none; None: not measured.

    Raises:
        SplatNotFitted: shapes that are not the camera's, or a mask without pixels.
    """

    camera: Camera
    picture: Array
    mask: Array | None = None
    depth: Array | None = None

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        if self.picture.shape != (*shape, 3) or self.picture.dtype != np.uint8:
            raise SplatNotFitted(
                f"the picture must be of shape {(*shape, 3)} uint8 as its camera is, got {self.picture.dtype} "
                f"{self.picture.shape}"
            )
        for name, found in (("mask", self.mask), ("depth", self.depth)):
            if found is not None and found.shape != shape:
                raise SplatNotFitted(f"the {name} has shape {found.shape}, its picture {shape}")
        if self.mask is not None and not self.mask.any():
            raise SplatNotFitted("the mask holds no pixel of the object")

    @property
    def inside(self) -> Array:
        """The object's pixels, (H, W) bool."""
        if self.mask is None:
            return np.ones(self.picture.shape[:2], dtype=bool)
        return np.asarray(self.mask, dtype=bool)


def surface_of(scene: Scene) -> Array:
    """Points (P, 3) [m] of the object's surface in the first frame: its cloud, else the tracked points seen there."""
    if scene.surface_points is not None and len(scene.surface_points):
        return scene.surface_points
    return np.asarray(scene.points[0][scene.visible[0]])


def start_from_depth(views: list[SplatView], most: int) -> Gaussians:
    """Gaussians on a grid of the object's pixels that have depth, one for every place that several cameras see.

    Args:
        views: those with depth are read.
        most: Gaussians at most; the grid is as wide as they need, and not below ``DENSEST_PX``.

    Raises:
        SplatNotFitted: no view has depth on the object.
    """
    measured = [(view, view.inside & (view.depth > 0)) for view in views if view.depth is not None]
    pixels = sum(int(inside.sum()) for _, inside in measured)
    if not pixels:
        raise SplatNotFitted(f"none of {len(views)} views has depth on the object; give points instead")
    spacing = max(DENSEST_PX, float(np.sqrt(pixels / most)))
    found = _on_grids(measured, spacing)
    while len(found) > most:  # pixels at edges do not divide evenly
        spacing *= WIDENED
        found = _on_grids(measured, spacing)
    return found


def _on_grids(measured: list[tuple[SplatView, Array]], spacing: float) -> Gaussians:
    places: list[Array] = []
    colours: list[Array] = []
    widths: list[Array] = []
    for view, inside in measured:
        found, at = _grid(view, inside, spacing)
        if not len(found):
            continue
        width = np.median(found[:, 2]) * spacing / view.camera.fx
        local = found - view.camera.world_to_camera[:3, 3]
        world = local @ view.camera.world_to_camera[:3, :3]
        if places:
            near = cKDTree(np.concatenate(places)).query(world, distance_upper_bound=width)[0]
            world, at = world[~np.isfinite(near)], at[~np.isfinite(near)]
        places.append(world)
        colours.append(view.picture[at[:, 0], at[:, 1]] / 255.0)
        widths.append(np.full(len(world), WIDTH_SHARE * width))
    return _spheres(np.concatenate(places), np.concatenate(colours), np.concatenate(widths))


def start_from_points(points: Array, views: list[SplatView], most: int) -> Gaussians:
    """Gaussians at points of the object's surface, in the colour of the pixel that shows them.

    Args:
        points: (P, 3) [m].
        views: cameras; a point takes its colour from the first in whose mask it is.
        most: Gaussians at most; of more points every k-th is taken.

    Raises:
        SplatNotFitted: fewer than two different points are finite and in some view's mask.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    points = np.unique(points[np.isfinite(points).all(axis=1)], axis=0)
    colours = np.full((len(points), 3), np.nan)
    for view in views:
        pixels, depths = view.camera.project(points)
        with np.errstate(invalid="ignore"):
            column, row = np.floor(np.where(np.isfinite(pixels), pixels, -1.0)).astype(np.int64).T
        height, width = view.picture.shape[:2]
        shown = (depths > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
        shown &= view.inside[row, column] & np.isnan(colours[:, 0])
        colours[shown] = view.picture[row[shown], column[shown]] / 255.0
    seen = np.flatnonzero(~np.isnan(colours[:, 0]))
    if len(seen) < 2:
        raise SplatNotFitted(
            f"{len(seen)} of {len(points)} points lie on the object in some view: are they of another frame or unit?"
        )
    seen = seen[:: max(1, -(-len(seen) // most))]
    near = cKDTree(points[seen]).query(points[seen], k=min(4, len(seen)))[0][:, 1:].mean(axis=1)
    return _spheres(points[seen], colours[seen], np.maximum(WIDTH_SHARE * near, 1e-5))


def _grid(view: SplatView, inside: Array, spacing: float) -> tuple[Array, Array]:
    """Places in the camera (P, 3) [m] of a grid of the pixels inside, and their rows and columns (P, 2)."""
    depth = smoothed(np.asarray(view.depth, dtype=np.float64), inside)
    height, width = inside.shape
    row, column = np.meshgrid(np.arange(0, height, spacing), np.arange(0, width, spacing), indexing="ij")
    at = np.unique(np.stack([row.ravel(), column.ravel()], axis=1).astype(np.int64), axis=0)
    at = at[inside[at[:, 0], at[:, 1]]]
    z = depth[at[:, 0], at[:, 1]]
    camera = view.camera
    x = (at[:, 1] + 0.5 - camera.cx) / camera.fx * z
    y = (at[:, 0] + 0.5 - camera.cy) / camera.fy * z
    return np.stack([x, y, z], axis=1), at


def smoothed(depth: Array, inside: Array) -> Array:
    """Depth averaged over the object's pixels around that are no step away, (H, W) [m].

    Args:
        depth: (H, W) [m].
        inside: pixels that count, (H, W) bool.
    """
    weight = inside.astype(np.float64)
    answer = depth
    for _ in range(2):
        mean = gaussian_filter(answer * weight, SMOOTHED_PX) / np.maximum(
            gaussian_filter(weight, SMOOTHED_PX), 1e-9
        )
        answer = np.where(inside & (np.abs(mean - depth) < STEP_M), mean, depth)
    return answer


def _spheres(places: Array, colours: Array, widths: Array) -> Gaussians:
    return Gaussians(
        places,
        np.repeat(np.log(widths)[:, None], 3, axis=1),
        np.tile([1.0, 0.0, 0.0, 0.0], (len(places), 1)),
        np.full(len(places), OPAQUE_LOGIT),
        ((colours - 0.5) / SH_DC)[:, None],
    )
