"""The volume of a body that cameras see from one side.

Nothing measures the far side, so it is guessed: the body is taken as symmetric about a smooth surface across the lines
of sight. On the outline of a smooth body the lines of sight touch it, so this middle surface goes through the outline.
A depth camera does not measure there, because the surface turns away; but near the outline the depth of a smooth
surface is a - b sqrt(d - d^2 / 2r) at d pixels from it, as of a circle of radius r = b^2 / 2 in pixels. Fitted to what
is measured around each place of the outline, a is the depth there. Where the body has an edge, b is small, and the
outline says nothing of the middle. So the middle surface is the quadratic one through these places, each with the
weight r^2, in the camera that looks most squarely at the body: it sees the largest area. Behind every seen place the
body reaches as far beyond it as the place lies before it. What a camera sees through, because it measures something
farther away there, is none of the body.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_closing, binary_erosion, binary_fill_holes, distance_transform_edt
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.tracking.depth import without_strays
from physworld.tracking.view import View, back_project, cloud_of

OUTLINE_STEP, AROUND_PX, LEAST_PIXELS = 4, 14, 40
"""Every so many pixels of an outline is a place of it. Its depth is from measured pixels so near, so many at least."""
BEYOND_PX, BEYOND_M = 6, 0.02
"""What is measured so near to the outline, on its other side, must be so much farther away: else it covers the body."""
ROUNDS, ROBUST = 5, 2.5
"""Of reweighting, and the robust deviations from which a pixel counts less."""
STRAY_M, LEAST_WEIGHT, BULGE = 3e-3, 0.01, 0.1
"""From the middle surface: from here on a place of the outline counts less; what an edge counts, which alone a body of
flat faces has; and how far, as a share of the body's size, the surface is expected to bulge: one deviation."""
CELL_M, CLOSING_CELLS = 3.75e-3, 2
"""Side of the columns that fill the body, and how wide a gap between them is closed."""
FRONT_SHARE = 0.25
"""Quantile of the distances in a column that is its front: others are strays, or farther parts seen from the side."""
THROUGH_M = 5e-3
"""What is measured so much behind a place shows that the place is empty."""
VOLUME_POINTS, LEAST_OUTLINE, LEAST_COLUMNS = 6000, 12, 30


def body_of_seen_side(views: list[View], masks: list[Array]) -> Array | None:
    """Points (M, 3) [m] that fill the body, or None: the cameras see too little of it.

    Args:
        views: the cameras.
        masks: the object in each one's first frame, (H, W) bool, or of no size.
    """
    looked = [
        (view, mask, without_strays(view.depth(0), view.camera, mask))
        for view, mask in zip(views, masks, strict=True)
        if mask.any()
    ]
    seen = [
        (view, mask, cloud_of(view.camera, view.depth(0), known)[0])
        for view, mask, known in looked
        if known.any()
    ]
    if not seen:
        return None
    widest, mask, _ = max(seen, key=lambda one: _area(*one))
    rims, turned = outline_places(widest, mask)
    if len(rims) < LEAST_OUTLINE:
        return None
    axes, eye = widest.camera.world_to_camera[:3, :3], widest.camera.centre
    distance = float(np.mean((rims - eye) @ axes[2]))

    def flat(points: Array) -> tuple[Array, Array]:
        """Places on a plane through the centre, (P, 2) [m], and depths (P,) [m], as a camera at the eye has them."""
        local = (points - eye) @ axes.T
        return local[:, :2] / local[:, 2:] * distance, local[:, 2]

    filled = _columns(
        *flat(np.concatenate([*(cloud for _, _, cloud in seen), rims])),
        *flat(rims),
        turned**4 / np.mean(turned**4) + LEAST_WEIGHT,
    )
    if filled is None:
        return None
    at, depth = filled
    local = np.concatenate([at * (depth / distance)[:, None], depth[:, None]], axis=1)
    return _not_seen_through(local @ axes + eye, [view for view, _, _ in seen])


def outline_places(view: View, mask: Array) -> tuple[Array, Array]:
    """Places (R, 3) [m] on the outline of the body in a camera's first frame, and how the surface turns away there, b
    [m / sqrt(px)], (R,).

    Args:
        view: the camera.
        mask: the object, (H, W) bool.
    """
    depth = view.depth(0).astype(np.float64)
    known = np.argwhere(without_strays(depth, view.camera, mask))
    beyond = np.argwhere(~mask & (depth > 0))
    edge = np.argwhere(mask & ~binary_erosion(mask))
    if min(len(known), len(beyond), len(edge)) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    inside = distance_transform_edt(mask) - 0.5
    trees = [cKDTree(pixels) for pixels in (known, beyond, edge)]
    pixels, fitted = [], []
    for place in edge[::OUTLINE_STEP]:
        own, other, along = (
            tree.query_ball_point(place, reach)
            for tree, reach in zip(trees, (AROUND_PX, BEYOND_PX, AROUND_PX), strict=True)
        )
        if len(own) < LEAST_PIXELS or not other:
            continue
        near = known[own]
        measured = depth[tuple(near.T)]
        if np.median(depth[tuple(beyond[other].T)]) < np.median(measured) + BEYOND_M:
            continue
        border = edge[along] - edge[along].mean(axis=0)
        tangent = np.linalg.svd(border, full_matrices=False)[2][0]
        side = np.median(measured) / np.sqrt(view.camera.fx * view.camera.fy)
        pixels.append(place[::-1] + 0.5)
        fitted.append(_turning((near - place) @ tangent, inside[tuple(near.T)], measured, side))
    if not pixels:
        return np.zeros((0, 3)), np.zeros(0)
    depths, turns = np.array(fitted).T
    return back_project(view.camera, np.stack(pixels), depths), turns


def _turning(along: Array, inside: Array, depth: Array, pixel_m: float) -> tuple[float, float]:
    """The depth [m] on the outline, and b [m / sqrt(px)], by least squares that are reweighted as Cauchy's.

    Args:
        along, inside: where pixels lie, along the outline and from it, (P,) [px].
        depth: (P,) [m].
        pixel_m: side of a pixel on the body [m].
    """
    weights, round_off = np.ones(len(depth)), np.ones(len(depth))
    for _ in range(ROUNDS):
        basis = np.stack([np.ones(len(depth)), along, -np.sqrt(inside * round_off)], axis=1)
        found = np.linalg.lstsq(basis * weights[:, None], depth * weights, rcond=None)[0]
        miss = np.abs(depth - basis @ found)
        weights = 1.0 / np.sqrt(1.0 + (miss / (ROBUST * 1.4826 * np.median(miss) + 1e-9)) ** 2)
        radius_px = max(0.5 * (found[2] / pixel_m) ** 2, AROUND_PX)
        round_off = 1.0 - 0.5 * inside / radius_px
    return float(found[0]), max(float(found[2]), 0.0)


def _area(view: View, mask: Array, cloud: Array) -> float:
    """What a mask covers at the distance of the body, relative to other cameras' [m^2]."""
    away = float(np.median(view.camera.project(cloud)[1]))
    return float(mask.sum()) * away**2 / (view.camera.fx * view.camera.fy)


def _columns(
    at: Array, depth: Array, rim_at: Array, rim_depth: Array, rim_weight: Array
) -> tuple[Array, Array] | None:
    """Places (M, 2) and depths (M,) [m] that fill the body between what is seen and its image behind the middle.

    Args:
        at, depth: of what is seen, (P, 2) and (P,) [m].
        rim_at, rim_depth: of the outline, (R, 2) and (R,) [m].
        rim_weight: of each of its places in the middle surface, (R,).
    """
    low = at.min(axis=0)
    index = np.floor((at - low) / CELL_M).astype(int) + CLOSING_CELLS
    shape = tuple(index.max(axis=0) + CLOSING_CELLS + 1)
    order = np.lexsort((depth, index[:, 1], index[:, 0]))
    index, depth = index[order], depth[order]
    begin = np.flatnonzero(np.r_[True, np.any(np.diff(index, axis=0) != 0, axis=1)])
    count = np.diff(np.r_[begin, len(index)])
    own = tuple(index[begin].T)
    known = np.zeros(shape, dtype=bool)
    front, deepest = np.zeros(shape), np.full(shape, -np.inf)
    known[own] = True
    front[own] = depth[begin + (FRONT_SHARE * (count - 1)).astype(int)]
    deepest[own] = depth[begin + count - 1]
    covered = binary_fill_holes(binary_closing(known, iterations=CLOSING_CELLS)) | known
    if covered.sum() < LEAST_COLUMNS:
        return None
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    places = (np.argwhere(covered) - CLOSING_CELLS + 0.5) * CELL_M + low
    first = front[tuple(nearest)][covered]
    last = np.maximum(2.0 * _quadratic(rim_at, rim_depth, rim_weight, places) - first, deepest[covered])
    length = np.maximum(last - first, 0.0)
    weight = length * (first + last) ** 2  # a column widens with its distance
    if not weight.sum() > 0:
        return None
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(places), VOLUME_POINTS, p=weight / weight.sum())
    strewn = places[chosen] + CELL_M * rng.uniform(-0.5, 0.5, (VOLUME_POINTS, 2))
    return strewn, first[chosen] + length[chosen] * rng.uniform(size=VOLUME_POINTS)


def _quadratic(places: Array, depths: Array, weights: Array, query: Array) -> Array:
    """Depths (Q,) [m] at (Q, 2) of the quadratic surface through depths (R,) at places (R, 2) [m] of weights (R,)."""
    middle, scale = places.mean(axis=0), float(np.ptp(places, axis=0).max())

    def terms(at: Array) -> Array:
        x, y = ((at - middle) / scale).T
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)

    factor, start = np.sqrt(weights), np.zeros(6)
    flat = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])[3:] * (STRAY_M / (BULGE * scale))
    basis = np.concatenate([terms(places) * factor[:, None], flat])
    aims = np.concatenate([depths * factor, np.zeros(len(flat))])
    start[0] = np.median(depths)
    found = least_squares(
        lambda x: basis @ x - aims, start, jac=lambda x: basis, loss="soft_l1", f_scale=STRAY_M
    )
    surface: Array = terms(query) @ found.x
    return surface


def _not_seen_through(points: Array, views: list[View]) -> Array:
    """Those of points (M, 3) behind which no camera measures anything."""
    kept = np.ones(len(points), dtype=bool)
    for view in views:
        depth = view.depth(0)
        pixels, own = view.camera.project(points)
        within = (own > 0) & np.all((pixels >= 0) & (pixels < depth.shape[::-1]), axis=1)
        column, row = np.floor(pixels[within]).astype(int).T
        kept[within] &= ~(depth[row, column] > own[within] + THROUGH_M)
    return points[kept]
