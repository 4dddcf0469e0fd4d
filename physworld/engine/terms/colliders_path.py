"""Where a rigid collider is at any time: poses at knots, cubic between them.

Positions follow a monotone cubic (PCHIP). Rotations turn from knot to knot by R_i exp(h(s)), h a cubic whose ends have
the angular velocities of the knots: with equal ones at both ends this is slerp. Before the first and after the last
knot the collider stands still.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.errors import SceneUnsupported


@dataclass(frozen=True, eq=False)
class RigidPath:
    """Poses at knots.

    Attributes:
        times: (F,) [s], increasing; one knot is a collider at rest.
        positions: of the origin of the collider's frame, (F, 3) [m].
        rotations: from the collider's frame to the world, (F, 3, 3).
    """

    times: Array
    positions: Array
    rotations: Array

    def __post_init__(self) -> None:
        finite = all(np.isfinite(part).all() for part in (self.times, self.positions, self.rotations))
        if not finite or not len(self.times) or np.any(np.diff(self.times) <= 0):
            raise SceneUnsupported(
                f"a path of {len(self.times)} poses: every number must be finite and the times increase"
            )

    @classmethod
    def still(cls, position: Array | tuple[float, float, float], rotation: Array | None = None) -> RigidPath:
        """A collider that never moves."""
        turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=float)
        return cls(np.zeros(1), np.asarray(position, dtype=float)[None], turn[None])

    @property
    def moves(self) -> bool:
        """Whether it has more than one pose."""
        return len(self.times) > 1

    @cached_property
    def linear_velocities(self) -> Array:
        """At the knots, (F, 3) [m/s]."""
        if len(self.times) == 1:
            return np.zeros((1, 3))
        velocities: Array = PchipInterpolator(self.times, self.positions, axis=0).derivative()(self.times)
        return velocities

    @cached_property
    def turns(self) -> Array:
        """Rotation vectors from knot to knot in the frame of the collider, (F - 1, 3) [rad]."""
        steps = np.einsum("tji,tjk->tik", self.rotations[:-1], self.rotations[1:])
        return Rotation.from_matrix(steps).as_rotvec() if len(steps) else np.zeros((0, 3))

    @cached_property
    def angular_velocities(self) -> Array:
        """At the knots in the frame of the collider, (F, 3) [rad/s]: means of the two neighbouring turns' rates."""
        if len(self.times) == 1:
            return np.zeros((1, 3))
        rates = self.turns / np.diff(self.times)[:, None]
        ends = np.concatenate([rates[:1], rates, rates[-1:]])
        velocities: Array = 0.5 * (ends[:-1] + ends[1:])
        return velocities

    def poses(self, times: Array) -> tuple[Array, Array, Array, Array]:
        """Positions (T, 3) [m], rotations (T, 3, 3), velocities (T, 3) [m/s] and angular velocities in the world
        (T, 3) [rad/s] at ``times`` (T,): what the device computes, one launch a time.
        """
        from physworld.engine.terms.colliders_kernels import move_collider

        device_path = self.on_device("cpu")
        clock = wp.array(np.array([1.0, 1.0, 1.0]), dtype=wp.float64, device="cpu")
        counter = wp.array(np.array([0, 0, 1]), dtype=wp.int32, device="cpu")
        pose = wp.zeros(6, dtype=wp.vec3d, device="cpu")
        totals = wp.zeros(4, dtype=wp.float64, device="cpu")
        found = np.empty((len(times), 6, 3))
        for k, time in enumerate(np.asarray(times, dtype=float)):
            start = wp.array(np.array([time]), dtype=wp.float64, device="cpu")
            wp.launch(
                move_collider,
                1,
                inputs=[start, *device_path, clock, counter],
                outputs=[pose, totals],
                device="cpu",
            )
            found[k] = pose.numpy()
        return found[:, 0], found[:, 1:4], found[:, 4], found[:, 5]

    def on_device(self, device: str) -> list[wp.array]:
        """Arguments of :func:`physworld.engine.terms.colliders_kernels.move_collider` between the frame times and the
        clock."""
        turns, rates = self.turns, self.angular_velocities
        ends = np.einsum("tij,tj->ti", _right_jacobian_inverse(turns), rates[1:])
        vectors = [self.positions, self.linear_velocities, turns, rates[:-1], ends]
        padded = [part if len(part) else np.zeros((1, 3)) for part in vectors]
        return [
            wp.array(self.times, dtype=wp.float64, device=device),
            *(wp.array(np.ascontiguousarray(part), dtype=wp.vec3d, device=device) for part in padded),
            wp.array(np.ascontiguousarray(self.rotations), dtype=wp.mat33d, device=device),
        ]

    def fastest_m_s(self, reach_m: float) -> float:
        """A bound on the speed of points within ``reach_m`` of the frame's origin [m/s]: chords and a cubic's 3/2."""
        if len(self.times) == 1:
            return 0.0
        steps = np.diff(self.times)
        chords = np.linalg.norm(np.diff(self.positions, axis=0), axis=1) / steps
        turning = np.linalg.norm(self.turns, axis=1) / steps
        return float(1.5 * (chords + reach_m * turning).max())


def _right_jacobian_inverse(turns: Array) -> Array:
    """What takes an angular velocity in the turned frame to the rate of the rotation vector, (S, 3, 3)."""
    angle = np.linalg.norm(turns, axis=1)
    safe = np.maximum(angle, 1e-4)
    series = np.where(angle < 1e-4, 1 / 12, 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe)))
    zero = np.zeros(len(turns))
    x, y, z = turns.T
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    inverse: Array = np.eye(3) + 0.5 * skew + series[:, None, None] * (skew @ skew)
    return inverse
