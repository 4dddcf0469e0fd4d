"""How far a straight rope or a flat sheet reaches, by the cloud of its first frame and its declared size.

Points that are tracked keep away from a body's ends. The cloud around them (``Scene.surface_points``) shows its free
ends to a pixel or two, and not what a gripper covers: what is missing of a declared length lies at the end that is
held, and so does what is too much, pixels of the gripper.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.scene import AS_MEASURED, Scene

_LEAST = 100
"""Points of a cloud that show ends."""
_ENDS = (0.1, 99.9)
"""Percentiles of a cloud that are its ends: a point or two of it may lie beyond."""
_EDGE_PX = 1.5
"""Spacings of a cloud that it may lack at either end: what is missing beyond is covered."""
_AS_DECLARED = 0.15
"""Share by which a cloud may miss the declared length."""
_NEAR_END = 0.25
"""Share of the length within which a held end is held."""


def cloud_of_start(scene: Scene) -> Array | None:
    """The scene's cloud of the first frame (S, 3) [m], if it has one that shows a body's ends and no filling."""
    cloud = scene.surface_points
    return None if cloud is None or scene.rest_volume_points is not None or len(cloud) < _LEAST else cloud


def misplaced(scene: Scene, axes: int) -> list[Scene]:
    """The scene with its cloud one standard deviation off along each of its longest axes, a pixel of the camera.

    Args:
        scene: of a straight rope or a flat sheet at the start.
        axes: 1 or 2; none where no cloud tells where the body ends.
    """
    cloud = cloud_of_start(scene)
    if cloud is None or scene.initial_state == AS_MEASURED:
        return []
    longest = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=False)[2][:axes]
    return [replace(scene, surface_points=cloud + spacing_of(cloud) * axis) for axis in longest]


def spacing_of(cloud: Array) -> float:
    """Median distance [m] of a cloud's points (S, 3) from their nearest."""
    return float(np.median(cKDTree(cloud).query(cloud, k=2)[0][:, 1]))


def reach_along(
    along: Array, declared: float | None, held: Array, spacing: float
) -> tuple[float, float] | None:
    """Where a body begins along an axis and its length [m]; None where its declared length is not that of the cloud.

    Args:
        along: the cloud's coordinates, (S,) [m].
        declared: its length [m], or None.
        held: coordinates at which it is held, (H,) [m].
        spacing: of the cloud [m].
    """
    low, high = (float(end) for end in np.percentile(along, _ENDS))
    if declared is None:
        return low, high - low
    missing = declared - (high - low)
    if abs(missing) > _AS_DECLARED * declared:
        return None
    near = _NEAR_END * declared
    first, last = bool(np.any(held < low + near)), bool(np.any(held > high - near))
    edges = min(max(missing, 0.0), 2.0 * _EDGE_PX * spacing)
    lead = 0.5 if first == last else float(first)
    return low - 0.5 * edges - lead * (missing - edges), declared
