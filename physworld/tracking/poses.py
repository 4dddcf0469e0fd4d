"""A marker's motion from all that the cameras see of it: pixels, which tell turns about the line of sight and places
across it, and its plane, which tells the rest; each by its own noise.

In every frame the pose is the one of least squares over all cameras that see the marker: eight numbers of the four
points' pixels and three of the plane (:mod:`physworld.tracking.markers`) a camera, divided by deviations that fifth
differences over time tell. The four points' places on the plate are those that fit all frames best. Cameras that are
calibrated a little differently put the marker a little apart: their shifts are taken out, as
:func:`physworld.tracking.rigid.joined` does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.tracking.markers import SLOPE_PX, Sighted, sighted
from physworld.tracking.rigid import RigidPath, joined, rigid_path, shifts_of, without_noise
from physworld.tracking.smoothing import white_deviation
from physworld.tracking.view import View

LEAST_PIXEL, LEAST_PLANE = 0.03, 1e-6
"""Of a deviation [px], [1/m]: interpolated pictures are fitted onto one another with errors of that size that change as
slowly as the view does, which differences over time do not show; and no plane is known better."""
_ROUNDS, _STEPS = 3, 4
_RADIANS, _METRES = 1e-5, 1e-6  # steps of the finite differences
_HELD = 1e-6  # of the four points, which a turn of all poses moves as well


def marker_path(views: list[View], identity: int | None, dictionary: str) -> RigidPath:
    """The motion of a marker that is fixed to a gripper.

    Args:
        views: the cameras.
        identity, dictionary: see :func:`physworld.tracking.markers.sighted`.

    Raises:
        TrackingFailed: the marker is never seen.
    """
    seen = sighted(views, identity, dictionary)
    corners = [one.places(view) for one, view in zip(seen, views, strict=True)]
    rough = rigid_path(joined(corners))
    told = [
        _Told(view, one, shift, deviations)
        for view, one, shift in zip(views, seen, shifts_of(corners), strict=True)
        if (deviations := _deviations(one)) is not None
    ]
    known: Array = (
        np.any([one.seen for one in told], axis=0) if told else np.zeros(views[0].frames, dtype=bool)
    )
    if known.sum() < 3:
        return rough
    poses, covariances, misfit = _poses(told, rough, known)
    deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return without_noise(poses[:, :3], poses[:, 3:], known, rough.reference, misfit, deviations)


@dataclass(frozen=True)
class _Told:
    """What one camera tells: its sights, its shift [m], (3,), and the deviations of their eleven numbers, (11,)."""

    view: View
    sights: Sighted
    shift: Array
    deviations: Array

    @property
    def seen(self) -> Array:
        return self.sights.seen

    def misses(self, poses: Array, shape: Array) -> Array:
        """Expected minus seen over the deviations, (T, 11), 0 where not seen.

        Args:
            poses: rotation vector and place of the middle, (T, 6).
            shape: of the four points about it, (4, 3) [m].
        """
        camera, pixels = self.view.camera, self.sights.pixels
        turns = Rotation.from_rotvec(poses[:, :3]).as_matrix()
        world = np.einsum("tij,kj->tki", turns, shape) + poses[:, None, 3:] + self.shift
        local = world @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        expected = focal * local[..., :2] / local[..., 2:] + centre
        normal = np.cross(local[:, 1] - local[:, 0], local[:, 3] - local[:, 0])
        slopes = normal / np.einsum("ti,ti->t", normal, local.mean(axis=1))[:, None]
        middle = (pixels.mean(axis=1) - centre) / focal
        inverse = np.einsum("ti,ti->t", slopes[:, :2], middle) + slopes[:, 2]
        planes = np.column_stack([inverse, SLOPE_PX * slopes[:, :2] / focal])
        found = (
            np.concatenate([(expected - pixels).reshape(-1, 8), planes - self.sights.planes], axis=1)
            / self.deviations
        )
        return np.where(self.seen[:, None], found, 0.0)


def _deviations(sights: Sighted) -> Array | None:
    """Of the noise of what one camera sees, (11,); None where too little is seen to tell."""
    pixels = white_deviation(sights.pixels.reshape(-1, 8), sights.seen)
    planes = white_deviation(sights.planes, sights.seen)
    if pixels is None or planes is None:
        return None
    return np.concatenate(
        [np.full(8, max(float(np.median(pixels)), LEAST_PIXEL)), np.maximum(planes, LEAST_PLANE)]
    )


def _poses(told: list[_Told], rough: RigidPath, known: Array) -> tuple[Array, Array, float]:
    """Poses (T, 6), their covariances (T, 6, 6), nan where not seen, and how far pixels miss them [m]."""
    middle = rough.reference.mean(axis=0)
    shape = rough.reference - middle
    poses = np.concatenate([rough.turns, rough.carry(middle[None])[:, 0]], axis=1)
    scale = np.repeat([_RADIANS, _METRES], 3)
    for number in range(_ROUNDS):
        for _ in range(_STEPS):
            slopes, miss = _slopes(told, poses, shape, scale)
            normal = np.einsum("tmi,tmj->tij", slopes, slopes) + np.where(known, 0.0, 1.0)[
                :, None, None
            ] * np.eye(6)
            side = np.einsum("tmi,tm->ti", slopes, miss)
            poses = poses - np.linalg.solve(normal, side[..., None])[..., 0]
        if number < _ROUNDS - 1:
            shape = _shape(told, poses, shape)
    left = sum(float(np.sum(one.misses(poses, shape) ** 2)) for one in told)
    freedom = 11 * sum(int(one.seen.sum()) for one in told) - 6 * int(known.sum()) - shape.size
    covariances = np.linalg.inv(normal) * max(left / freedom, 1.0)
    covariances[~known] = np.nan
    off = np.concatenate([one.misses(poses, shape)[one.seen, :8].ravel() * one.deviations[0] for one in told])
    nearest = min(float(np.median(1.0 / one.sights.planes[one.seen, 0])) / one.view.camera.fx for one in told)
    return poses, covariances, float(np.std(off)) * nearest


def _slopes(told: list[_Told], poses: Array, shape: Array, scale: Array) -> tuple[Array, Array]:
    """Derivatives of what all cameras miss after the pose, (T, m, 6), and what they miss, (T, m)."""
    miss = np.concatenate([one.misses(poses, shape) for one in told], axis=1)
    columns = []
    for k, step in enumerate(scale):
        beside = poses.copy()
        beside[:, k] += step
        there = np.concatenate([one.misses(beside, shape) for one in told], axis=1)
        columns.append((there - miss) / step)
    return np.stack(columns, axis=2), miss


def _shape(told: list[_Told], poses: Array, shape: Array) -> Array:
    """The four points (4, 3) [m] that fit the poses best."""
    miss = np.concatenate([one.misses(poses, shape).ravel() for one in told])
    columns = []
    for k in range(shape.size):
        beside = shape.copy()
        beside.ravel()[k] += _METRES
        columns.append((np.concatenate([one.misses(poses, beside).ravel() for one in told]) - miss) / _METRES)
    slopes = np.stack(columns, axis=1)
    normal = slopes.T @ slopes
    normal += _HELD * np.trace(normal) * np.eye(len(normal))
    moved: Array = shape - np.linalg.solve(normal, slopes.T @ miss).reshape(shape.shape)
    return moved
