"""Depth of tracked points: a plane through the depth pixels of the patch that are on the object.

A depth camera gives every pixel an error and loses some; the pixels of a patch together give its middle better than
any of them. On a plane 1/Z is linear in the pixel, so that is what is fitted. Pixels of the patch that were not on the
object in the first frame are left out, and those far from the patch's median, which are of something before or
behind it.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.tracking.view import back_project

ROUNDS = 3
LEAST_PIXELS = 6
BAND_M = 0.015
"""From the patch's median; a patch of 1 cm that is seen at 60 degrees spans as much."""
STRAY_PX, STEEP = 5, 2.7
"""Half the side of a window, and the slope of a surface seen at 70 degrees. A pixel that is farther from the window's
median than such a surface gets mixes the object with what is behind it."""
FLAT_SIGMAS = 3.5
"""Robust deviations of a plane's own pixels: farther from it lies another surface."""


def patch_depth(depth: Array, pixels: Array, spread: Array, inside: Array, expected: Array) -> Array:
    """Depth (N,) [m] at ``pixels``, nan where too few pixels of the patch have any.

    Args:
        depth: (H, W) [m], 0: none.
        pixels: (N, 2).
        spread: the patch's pixels from its middle, as the surface has moved, (N, P, 2).
        inside: which of them are on the object, (N, P) bool.
        expected: depth that neighbours lead to expect [m], (N,); nan: the median of the patch.
    """
    height, width = depth.shape
    at = pixels[:, None] + spread
    finite = np.isfinite(at).all(axis=2)
    column = np.floor(np.where(finite, at[..., 0], -1)).astype(int)
    row = np.floor(np.where(finite, at[..., 1], -1)).astype(int)
    valid = inside & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    measured = depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].astype(np.float64)
    valid &= measured > 0
    # pixels are read at their middles, not where the patch's pixel fell
    middle = np.stack([column, row], axis=-1) + 0.5 - pixels[:, None]
    centre = _median(measured, valid)
    around = np.where(np.isfinite(expected), expected, centre)
    valid &= np.abs(measured - around[:, None]) < 2.0 * BAND_M
    centre = _median(measured, valid)
    valid &= np.abs(measured - centre[:, None]) < BAND_M
    inverse = np.where(valid, 1.0 / np.where(valid, measured, 1.0), 0.0)
    enough = valid.sum(axis=1) >= LEAST_PIXELS
    design = np.concatenate([np.ones((*valid.shape, 1)), middle], axis=2)
    weights = valid.astype(np.float64)
    answer = np.zeros((len(pixels), 3))
    for _ in range(ROUNDS):
        normal = np.einsum("np,npi,npj->nij", weights, design, design)
        side = np.einsum("np,npi,np->ni", weights, design, inverse)
        # slopes are held near none where the pixels lie in a line or a corner
        held = np.zeros((3, 3))
        held[1, 1] = held[2, 2] = 1.0
        answer = np.linalg.solve(normal + held + 1e-9 * np.eye(3), side[..., None])[..., 0]
        miss = np.abs(inverse - np.einsum("npi,ni->np", design, answer))
        scale = _median(miss, valid) * 1.4826 * 2.5
        weights = valid / (1.0 + (miss / np.maximum(np.where(enough, scale, 1.0), 1e-6)[:, None]) ** 2)
    fine = enough & (answer[:, 0] > 0)
    found: Array = np.where(fine, 1.0 / np.where(fine, answer[:, 0], 1.0), np.nan)
    return found


def plane_in(depth: Array, camera: Camera, rows: Array, columns: Array) -> tuple[float, float, float] | None:
    """Coefficients (a, b, c) of 1/Z = a + b u + c v [1/m, 1/(m px)] of the pixels' plane; None: too few have depth.

    Args:
        depth: (H, W) [m], 0: none.
        camera: whose principal point u and v are counted from.
        rows, columns: of the pixels, (P,).
    """
    measured = depth[rows, columns]
    valid = measured > 0
    if valid.sum() < 4 * LEAST_PIXELS:
        return None
    design = np.stack(
        [np.ones(valid.sum()), columns[valid] + 0.5 - camera.cx, rows[valid] + 0.5 - camera.cy], axis=1
    )
    inverse, weights = 1.0 / measured[valid], np.ones(int(valid.sum()))
    for _ in range(5):
        answer = np.linalg.lstsq(design * weights[:, None], inverse * weights, rcond=None)[0]
        miss = np.abs(inverse - design @ answer)
        weights = 1.0 / np.sqrt(1.0 + (miss / (2.0 * np.median(miss) + 1e-9)) ** 2)
    return float(answer[0]), float(answer[1]), float(answer[2])


def flat_part(
    depth: Array,
    camera: Camera,
    plane: tuple[float, float, float],
    inner: tuple[Array, Array],
    outer: tuple[Array, Array],
) -> tuple[float, float, float]:
    """The plane of those of the outer pixels that lie in the plane of the inner ones, as ``plane_in`` gives it.

    Args:
        depth: (H, W) [m], 0: none.
        camera: see ``plane_in``.
        plane: of the inner pixels.
        inner, outer: rows and columns.
    """

    def misses(pixels: tuple[Array, Array], of: Array) -> tuple[Array, Array]:
        rows, columns = (axis[depth[pixels] > 0] for axis in pixels)
        design = np.stack([np.ones(len(rows)), columns + 0.5 - camera.cx, rows + 0.5 - camera.cy], axis=1)
        return 1.0 / depth[rows, columns].astype(np.float64) - design @ of, design

    found = np.array(plane)
    bound = FLAT_SIGMAS * 1.4826 * float(np.median(np.abs(misses(inner, found)[0]))) + 1e-9
    for _ in range(ROUNDS):
        miss, design = misses(outer, found)
        flat = np.abs(miss) < bound
        found = found + np.linalg.lstsq(design[flat], miss[flat], rcond=None)[0]
    return float(found[0]), float(found[1]), float(found[2])


def on_plane(plane: tuple[float, float, float], camera: Camera, pixels: Array) -> Array:
    """Places (P, 3) [m] of pixels (P, 2) on a plane of ``plane_in``."""
    inverse = plane[0] + plane[1] * (pixels[:, 0] - camera.cx) + plane[2] * (pixels[:, 1] - camera.cy)
    return back_project(camera, pixels, 1.0 / inverse)


def without_strays(depth: Array, camera: Camera, mask: Array) -> Array:
    """The mask (H, W) without pixels that have no depth, or one far from that of the mask's pixels around them.

    Args:
        depth: (H, W) [m], 0: none.
        camera: whose picture it is.
        mask: (H, W) bool.
    """
    measured = mask & (depth > 0)
    rows, columns = np.nonzero(measured)
    side = np.arange(-STRAY_PX, STRAY_PX + 1, 2)
    down, right = (part.ravel() for part in np.meshgrid(side, side, indexing="ij"))
    height, width = depth.shape
    near = (
        np.clip(rows[:, None] + down, 0, height - 1),
        np.clip(columns[:, None] + right, 0, width - 1),
    )
    around = _median(depth[near], measured[near])
    bound = np.maximum(BAND_M, STEEP * STRAY_PX * around / camera.fx)
    kept = measured.copy()
    kept[measured] = np.abs(depth[measured] - around) <= bound
    return kept


def _median(values: Array, valid: Array) -> Array:
    """Of the valid values of every row, nan where there is none, (N,)."""
    kept = np.sort(np.where(valid, values, np.inf), axis=1)
    count = valid.sum(axis=1)
    middle = kept[np.arange(len(kept)), np.maximum(count - 1, 0) // 2]
    return np.where(count > 0, middle, np.nan)
