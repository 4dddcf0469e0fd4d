"""How noisy tracked points are: more along the line of sight than across it, and more the farther they are.

A stereo or structured-light camera errs along its rays by k Z^2 and a tracker across them by p Z (Khoshelham and
Elberink, Sensors 12, 2012, 1437-1454; p: its error in pixels over the focal length). k and p are what third differences
over time leave along and across the rays. Errors that change slowly are not in these. Where the recording has frames in
which nothing moves, all of the points' scatter in them counts.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.tracking.view import View

_THIRD = 20.0  # sum of squares of 1, -3, 3, -1
_MEDIAN_OF_NORMAL = 0.6745
_FEWEST = 30  # differences that tell a deviation
_STILL_FRAMES = 12
_STILL = 3.0  # times the white noise: a window whose points scatter more shows motion


def sighting_covariances(points: Array, visible: Array, cameras: Array, views: list[View]) -> Array | None:
    """Covariance of a sighting of every point, (N, 3, 3) [m^2]; None where too little was seen to tell.

    Args:
        points: (T, N, 3) [m].
        visible: (T, N) bool.
        cameras: the camera that follows each point, (N,).
        views: the cameras, in the world of the points.
    """
    found = np.zeros((points.shape[1], 3, 3))
    for number in np.unique(cameras):
        own = np.flatnonzero(cameras == number)
        known = _of_camera(points[:, own], visible[:, own], views[number].camera.world_to_camera)
        if known is None:
            return None
        found[own] = known
    return found


def _of_camera(points: Array, visible: Array, world_to_camera: Array) -> Array | None:
    """The same of the points of one camera, whose pose is (4, 4)."""
    local = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    seen = np.maximum(visible.sum(axis=0), 1)
    middle = np.where(visible[..., None], local, 0.0).sum(axis=0) / seen[:, None]
    far = np.linalg.norm(middle, axis=1)
    if not (far > 0.0).all():
        return None
    ray = middle / far[:, None]
    across = _across(ray)
    parts = np.stack([np.einsum("tni,ni->tn", local, axis) for axis in (ray, *across)], axis=-1)
    scale = np.stack([far**2, far, far], axis=1)
    along_k, across_p = (
        _deviation(parts[..., axes] / scale[:, axes], visible) for axes in (slice(0, 1), slice(1, 3))
    )
    if along_k is None or across_p is None:
        return None
    deviations = np.stack([along_k * scale[:, 0], across_p * scale[:, 1], across_p * scale[:, 2]], axis=1)
    axes = np.stack([ray, *across], axis=-1)
    covariance: Array = np.einsum("nij,nj,nkj->nik", axes, deviations**2, axes)
    turn = world_to_camera[:3, :3]
    return turn.T @ covariance @ turn


def _deviation(values: Array, visible: Array) -> float | None:
    """Of values (T, N, c) about what is smooth in time; None where too few are seen four times running."""
    third = np.diff(values, n=3, axis=0)
    running = visible[3:] & visible[2:-1] & visible[1:-2] & visible[:-3]
    if running.sum() < _FEWEST:
        return None
    white = float(np.median(np.abs(third[running]))) / (_MEDIAN_OF_NORMAL * _THIRD**0.5)
    if not white > 0.0:
        return None
    still = _scatter(values, visible)
    return float(max(white, still)) if still < _STILL * white else white


def _scatter(values: Array, visible: Array) -> float:
    """Median deviation of the points about their means in the calmest window of frames; infinite without any."""
    found = [np.inf]
    for begin in range(0, len(values) - _STILL_FRAMES + 1, _STILL_FRAMES // 2):
        window = slice(begin, begin + _STILL_FRAMES)
        whole = visible[window].all(axis=0)
        if whole.any():
            found.append(float(np.median(values[window][:, whole].std(axis=0, ddof=1))))
    return min(found)


def _across(rays: Array) -> tuple[Array, Array]:
    """Two unit vectors (N, 3) across every ray (N, 3) and across each other."""
    least = np.eye(3)[np.argmin(np.abs(rays), axis=1)]
    one = np.cross(rays, least)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return one, np.cross(rays, one)
