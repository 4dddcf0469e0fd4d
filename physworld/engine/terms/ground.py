"""Ground whose friction is a field over the body: one coefficient for every contact point.

A field is given as a factor of the ground's own coefficient at every particle; a contact point takes that of the
particle next to it. Without a field the ground is a collider like any other (:mod:`physworld.engine.terms.contact`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.engine.terms.colliders import BoundCollider, Collider, ContactSurface
from physworld.engine.terms.colliders_kernels import move_collider
from physworld.engine.terms.ground_kernels import touch_ground

if TYPE_CHECKING:
    from physworld.engine.problem import Problem


class BoundGround(BoundCollider):
    """A still, level plane and the points of a body on a device, each with its own friction.

    Args:
        plane: the ground; its friction is multiplied with the factors.
        height_m: of the plane.
        surface: the body's contact points.
        problem: its ``friction_factor`` has a positive number for every particle, (P,).

    Attributes:
        differentiated: the coefficients of the points on the device, (S,): a reverse pass finds derivatives by them.

    Raises:
        ValueError: there is no factor for every particle, or one is negative or not finite.
    """

    def __init__(self, plane: Collider, height_m: float, surface: ContactSurface, problem: Problem) -> None:
        super().__init__(plane, surface, problem)
        factor, lattice = problem.friction_factor, problem.lattice
        if (
            factor is None
            or len(factor) != lattice.fill.size
            or not np.all((factor >= 0) & (factor < np.inf))
        ):
            raise ValueError(
                f"a friction factor for each of {lattice.fill.size} particles is needed, finite and not negative"
            )
        filled = np.flatnonzero(lattice.particle_measures > 0)
        tree = cKDTree(lattice.particle_coordinates[filled] / lattice.spacing)
        self._particles = filled[tree.query(surface.points / lattice.spacing)[1]]
        self._count = lattice.fill.size
        coefficients = plane.friction * np.asarray(factor, dtype=float)[self._particles]
        self._friction = wp.array(coefficients, dtype=wp.float64, device=self.device)
        self._height = wp.float64(height_m)
        self.differentiated = self._friction

    def by_log_factor(self, bar: Array) -> Array:
        """Derivatives by the logarithms of the particles' factors, (P,), from those by ``differentiated``, (S,)."""
        found = np.zeros(self._count)
        np.add.at(found, self._particles, bar * self._friction.numpy())
        return found

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
            touch_ground, self.points,
            inputs=[
                *self._surface[:-1], self._friction, self._height, x, v, clock, counter, self._watched(x, counter),
                self._clearance, self._stretch,
            ],
            outputs=[force, self._totals], device=device,
        )  # fmt: skip
