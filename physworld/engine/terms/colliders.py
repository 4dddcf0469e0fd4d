"""Rigid colliders that move: penalty pressure and Coulomb friction between one of them and the points of a body.

    depth = offset - d(x)           d: signed distance of the collider at its pose, offset: half the body's thickness
    pressure p = max(0, k depth - c approach)                     so that nothing is ever held back on separation
    friction: k_t slip + c_t slide, at most mu p                  slip: elastic, forgotten when the contact opens

A penalty lets a body in by about v dx / c when it comes at speed v. Beyond half the collider's own depth over that, a
point could come out on its other side: such a speed is refused, and a run in which a point came that deep is not
trusted (:class:`physworld.errors.ContactFailed`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from scipy import sparse

from physworld.arrays import Array
from physworld.engine.terms.colliders_kernels import move_collider, touch_collider, watch_nodes
from physworld.engine.terms.colliders_path import RigidPath
from physworld.engine.terms.term import BoundTerm
from physworld.errors import ContactFailed
from physworld.shapes.sdf import Shape

if TYPE_CHECKING:
    from physworld.engine.problem import Problem

_SPEED_SHARE = 0.5  # of the speed whose penetration is the collider's own depth
_LIGHT = (
    0.1  # a node with less weight in any point counts for less: it may swing fast and carry next to nothing
)
_QUOTIENTS = 30  # steps towards the sharpest bound: within some per cent of it
_DEPTH_SHARE = 0.9  # of the collider's own depth: deeper, the nearest way out may be the wrong one


@dataclass(frozen=True, eq=False)
class Collider:
    """A rigid shape on its way.

    Attributes:
        name: for messages.
        shape: signed distances in its own frame.
        path: its poses.
        friction: Coulomb's coefficient against the body.
    """

    name: str
    shape: Shape
    path: RigidPath
    friction: float

    def distance(self, points: Array, time_s: float) -> Array:
        """Signed distances [m], (M,), at ``points`` (M, 3) in the world."""
        place, turn = self._pose(time_s)
        return self.shape.distance((points - place) @ turn)

    def normal(self, points: Array, time_s: float) -> Array:
        """Outward unit normals in the world, (M, 3)."""
        place, turn = self._pose(time_s)
        return self.shape.normal((points - place) @ turn) @ turn.T

    def velocity(self, points: Array, time_s: float) -> Array:
        """Velocity [m/s] of the collider's material at ``points`` (M, 3) in the world."""
        place, _, velocity, spin = self.path.poses(np.array([time_s]))
        return velocity + np.cross(spin, points - place)

    def _pose(self, time_s: float) -> tuple[Array, Array]:
        place, turn, _, _ = self.path.poses(np.array([time_s]))
        return place[0], turn[0]


@dataclass(frozen=True, eq=False)
class ContactSurface:
    """The points of a body that touch.

    Attributes:
        points: reference coordinates (S, d) [m].
        measures: area, or length of a rod, that each stands for, (S,).
        groups: points of one group may touch at the same time, (S,).
        offsets: distance at which each touches [m], (S,).
        stiffness, shear_stiffness: normal and tangential, per measure [N/m^3 of an area, N/m^2 of a length].
        damping: in both directions, per measure [N s/m^3, N s/m^2].
        rate_per_s: c / dx; a speed over it is the depth to which a body comes in [1/s].
    """

    points: Array
    measures: Array
    groups: Array
    offsets: Array
    stiffness: float
    shear_stiffness: float
    damping: float
    rate_per_s: float


class BoundCollider(BoundTerm):
    """A collider and the points of a body on a device.

    What it adds to the time step is bounded by :func:`largest_share`: no group of points that touch at once can exceed
    it, whatever the fill of the cells.
    """

    def __init__(self, collider: Collider, surface: ContactSurface, problem: Problem) -> None:
        device = problem.device
        matrix = problem.lattice.interpolation(surface.points)
        matrix.eliminate_zeros()  # a layer of nodes says nothing of a face between cells
        self.collider, self.points, self.device = collider, len(surface.points), device
        self._rate = surface.rate_per_s
        mass = problem.nodal_mass()
        per_mass = max(
            largest_share(matrix, np.where(surface.groups == group, surface.measures, 0.0), mass)
            for group in np.unique(surface.groups)
        )
        self.frequency_rad_s = float(np.sqrt(surface.stiffness * per_mass))
        self.friction_per_s = surface.damping * per_mass
        self._path = collider.path.on_device(device)
        self._shape = collider.shape.on_device(device)
        self._surface = [
            wp.array(matrix.indptr, dtype=wp.int32, device=device),
            wp.array(matrix.indices, dtype=wp.int32, device=device),
            wp.array(matrix.data, dtype=wp.float64, device=device),
            wp.array(surface.measures, dtype=wp.float64, device=device),
            wp.array(np.ascontiguousarray(surface.offsets), dtype=wp.float64, device=device),
            *(
                wp.float64(number)
                for number in (
                    surface.stiffness, surface.shear_stiffness, surface.damping, surface.damping, collider.friction
                )
            ),
        ]  # fmt: skip
        self._deepest_allowed = _DEPTH_SHARE * collider.shape.inner_m + float(
            surface.offsets.max(initial=0.0)
        )
        self._pose = wp.zeros(6, dtype=wp.vec3d, device=device)
        self._totals = wp.zeros(4, dtype=wp.float64, device=device)
        self._stretch = wp.zeros(self.points, dtype=wp.vec3d, device=device)
        self.memory = (self._stretch,)
        self._near = not collider.path.moves and collider.shape.exact
        self._clearance = wp.zeros(self.points, dtype=wp.float64, device=device)
        self._reach = wp.array(reach_of_nodes(matrix), dtype=wp.float64, device=device)
        self._seen = wp.zeros(3 * len(mass), dtype=wp.float64, device=device)
        self._travel = wp.full(2, 0.0 if self._near else np.inf, dtype=wp.float64, device=device)
        self._times = wp.zeros(1, dtype=wp.float64, device=device)

    @property
    def speed_limit_m_s(self) -> float:
        """Fastest that any point of the collider may move."""
        return _SPEED_SHARE * self.collider.shape.inner_m * self._rate

    @property
    def impulse_n_s(self) -> Array:
        """What the collider gave to the body since the start of the last run [N s], (3,)."""
        impulse: Array = self._totals.numpy()[:3]
        return impulse

    @property
    def deepest_m(self) -> float:
        """How deep the body came into the collider in the last run."""
        return float(self._totals.numpy()[3])

    def begin(self, times: Array) -> None:
        """Keep the frame times.

        Raises:
            ContactFailed: the collider moves too fast for the penalty.
        """
        fastest = self.collider.path.fastest_m_s(self.collider.shape.reach_m)
        if fastest > self.speed_limit_m_s:
            raise ContactFailed(
                f"{self.collider.name} moves at up to {fastest:.3g} m/s; {self.speed_limit_m_s:.3g} m/s is the most at "
                f"which contact holds for a collider {2 * self.collider.shape.inner_m:.3g} m thick and a body whose "
                f"waves cross {self._rate:.4g} cells a second"
            )
        self._times = wp.array(np.ascontiguousarray(times), dtype=wp.float64, device=self.device)

    def check(self, time_s: float) -> None:
        """After a frame.

        Raises:
            ContactFailed: a point of the body came so deep that it may leave on the wrong side.
        """
        if np.isfinite(self._deepest_allowed) and self.deepest_m > self._deepest_allowed:
            raise ContactFailed(
                f"a point came {self.deepest_m:.3g} m into {self.collider.name} before t = {time_s:.4f} s; beyond "
                f"{self._deepest_allowed:.3g} m it may leave on the wrong side"
            )

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add contact forces [N] at nodal positions and velocities (3n,) to ``force``.

        Args:
            x, v, clock, counter, force: as in :meth:`BoundTerm.launch`.
        """
        device = self.device
        wp.launch(
            move_collider, 1, inputs=[self._times, *self._path, clock, counter],
            outputs=[self._pose, self._totals], device=device,
        )  # fmt: skip
        wp.launch(
            touch_collider, self.points,
            inputs=[
                *self._shape, *self._surface, self._pose, x, v, clock, counter, self._watched(x, counter),
                self._clearance, self._stretch,
            ],
            outputs=[force, self._totals], device=device,
        )  # fmt: skip

    def _watched(self, x: wp.array, counter: wp.array) -> wp.array:
        """How far points went at most since the last look [m], (2,) by the substep's parity.

        Infinite beside a collider that moves, or whose distances are those of samples: every point is looked at.
        """
        if self._near:
            wp.launch(
                watch_nodes, len(x) // 3, inputs=[self._reach, x, counter], outputs=[self._seen, self._travel],
                device=self.device, record_tape=False,
            )  # fmt: skip
        return self._travel


def largest_share(matrix: sparse.csr_matrix, measures: Array, mass: Array) -> float:
    """A bound from above on the largest eigenvalue of M^-1 W^T A W, per measure of stiffness [1/kg times A's unit].

    Args:
        matrix: weights W of points by nodes, (S, n).
        measures: A of every point, (S,), not negative.
        mass: lumped masses M, (n,) [kg].

    With |W| the matrix has no negative entry, so its quotients (K x)_i / (m_i x_i) bound it for any positive x (Collatz
    1942, Wielandt 1950); with x = 1 they are Gershgorin's, and steps of the power iteration make the bound sharper.
    """
    weights = abs(matrix)
    touched = np.asarray(weights.T @ measures) > 0
    weights, mass = weights[:, touched], mass[touched]
    x, bound = np.ones(len(mass)), np.inf
    for _ in range(_QUOTIENTS):
        response = np.asarray(weights.T @ (measures * (weights @ x))) / mass
        bound = min(bound, float((response / x).max(initial=0.0)))
        x = response / response.max(initial=np.finfo(float).tiny)
    return bound


def reach_of_nodes(matrix: sparse.csr_matrix) -> Array:
    """Factors r of the nodes, (n,), with which no point goes farther than the greatest r_i |d_i| of their ways d.

    Args:
        matrix: weights of points by nodes, (S, n).

    A point goes sum_i w_i d_i, at most sum_i (w_i / s_i) times the greatest s_i |d_i| for any positive s.
    """
    weights = abs(matrix)
    share = np.minimum(1.0, weights.max(axis=0).toarray().reshape(-1) / _LIGHT)
    bearing = np.divide(1.0, share, out=np.zeros_like(share), where=share > 0)
    factors: Array = share * float((weights @ bearing).max(initial=0.0))
    return factors
