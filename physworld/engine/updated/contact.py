"""Contact in the updated Lagrangian form: a rigid collider, or the ground, and the particles near it.

The collider and its way are those of the total Lagrangian form (:mod:`physworld.engine.terms.colliders`); contact is
made by impulses on the grid instead of a penalty (:mod:`physworld.engine.updated.contact_kernels`), since the surface
of what flows is no lattice's. It adds no stiffness, so it takes nothing from the time step.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.lattice.bspline import GAUSS_POINTS
from physworld.engine.terms.colliders import Collider
from physworld.engine.terms.colliders_kernels import move_collider
from physworld.engine.updated.contact_kernels import find_near, forget_near, press, sift
from physworld.engine.updated.grid_box import GridLattice
from physworld.errors import ContactFailed
from physworld.shapes.sdf_kernels import HALF_SPACE

_SIGHT = 0.5  # cells: particles cross less than that in a substep
_LEAVING = 0.1  # of its depth that material inside a collider leaves in a substep
_FASTEST = 0.002  # cells a substep, at most, that it leaves
_GROUP = 32  # particles that a thread sifts in turn on a CPU
_RELAXATION = 1.0 / 16.0  # where all particles of a contact act at once: up to 9 nodes' worth of them overlap
_CRUSHED = 30.0  # wave moduli: an impact at the speed of waves presses with about one
_DEPTH_SHARE = 0.9  # of a collider's own depth: deeper, the nearest way out may be the wrong one


class GridContact:
    """A collider and the particles of a body on a device.

    Args:
        collider: what pushes.
        lattice: the grid.
        friction: factors of the collider's friction, a particle (P,).
        modulus_pa: of the body's stiffest pressure waves.
        lenient: particles that start inside touch where they are and further in.
        device: Warp device.

    Attributes:
        at_once: the particles act all at once, as they do on CUDA, instead of in turns.
    """

    def __init__(
        self,
        collider: Collider,
        lattice: GridLattice,
        friction: Array,
        modulus_pa: float,
        lenient: bool,
        device: str,
    ) -> None:
        count = len(friction)
        self.collider, self._lattice, self._count, self._device = collider, lattice, count, device
        self._friction = wp.array(collider.friction * friction, dtype=wp.float32, device=device)
        self._lenient, self._modulus = lenient, modulus_pa
        self.at_once = wp.get_device(device).is_cuda
        self._cell = float(lattice.spacing.min())
        self._half = GAUSS_POINTS[0] * lattice.spacing
        sight = _SIGHT * self._cell
        # On a CPU a thread that finds nothing costs as much as one that does.
        self._threads = count if wp.get_device(device).is_cuda else 1
        self._plane = collider.shape.kind == HALF_SPACE
        self._reach = collider.shape.reach_m + sight + float(self._half.max())
        self._sight = sight
        self._path = collider.path.on_device(device)
        self._shape = collider.shape.on_device(device)
        self._pose = wp.zeros(6, dtype=wp.vec3d, device=device)
        self._totals = wp.zeros(4, dtype=wp.float64, device=device)
        self._relief = wp.zeros(count, dtype=wp.float64, device=device)
        self._turn = wp.zeros(1, dtype=wp.int32, device=device)
        self._last = wp.zeros(count, dtype=wp.int32, device=device)
        self._candidates = wp.zeros(count + 1, dtype=wp.int32, device=device)
        self._near = wp.zeros(count + 1, dtype=wp.int32, device=device)
        self._contact = wp.zeros(count, dtype=wp.vec4f, device=device)
        self._drive = wp.zeros(count, dtype=wp.vec3f, device=device)
        self._hardest = wp.zeros(1, dtype=wp.float32, device=device)
        self._impulse = wp.zeros(count, dtype=wp.vec3f, device=device)
        self._times = wp.zeros(1, dtype=wp.float64, device=device)

    @property
    def impulse_n_s(self) -> Array:
        """What the collider gave to the body since the start of the last run [N s], (3,)."""
        impulse: Array = self._totals.numpy()[:3]
        return impulse

    @property
    def deepest_m(self) -> float:
        """How deep a particle's face came into the collider in the last run [m]."""
        return float(self._totals.numpy()[3])

    @property
    def fastest_m_s(self) -> float:
        """A bound on the speed of the collider's points."""
        return self.collider.path.fastest_m_s(self.collider.shape.reach_m)

    @property
    def step_m(self) -> float:
        """How far a particle and the collider may come together in a substep [m]: else it might pass through."""
        return min(_SIGHT * self._cell, 0.5 * self.collider.shape.inner_m)

    def begin(self, times: Array, x: Array) -> None:
        """A run over the frames ``times`` (T,) [s] starts with particles at ``x`` (P, 3) [m]."""
        self._times = wp.array(np.ascontiguousarray(times), dtype=wp.float64, device=self._device)
        self._impulse.zero_()
        self._hardest.zero_()
        relief = np.zeros(self._count)
        if self._lenient:
            half = np.linalg.norm(self.collider.normal(x, times[0]) * self._half, axis=1)
            relief = np.minimum(self.collider.distance(x, times[0]) - half, 0.0)
        self._relief.assign(relief)

    def check(self, time_s: float, dt_s: float) -> None:
        """After some substeps of ``dt_s``.

        Raises:
            ContactFailed: a particle came so deep that it may leave on the wrong side, or is crushed.
        """
        area = 0.25 * float(np.prod(self._lattice.spacing)) ** (2 / 3)
        pressure = float(self._hardest.numpy()[0]) / (dt_s * area)
        if pressure > _CRUSHED * self._modulus:
            raise ContactFailed(
                f"{self.collider.name} pressed with {pressure:.3g} Pa on a particle before t = {time_s:.4f} s, "
                f"{pressure / self._modulus:.3g} times the body's wave modulus of {self._modulus:.3g} Pa: material "
                f"between colliders is thinner than the cells of {self._cell:.3g} m can show, or hit too fast"
            )
        allowed = _DEPTH_SHARE * self.collider.shape.inner_m
        deepest = self.deepest_m
        if np.isfinite(allowed) and deepest > allowed:
            raise ContactFailed(
                f"a particle came {deepest:.3g} m into {self.collider.name} before t = {time_s:.4f} s; beyond "
                f"{allowed:.3g} m it may leave on the wrong side"
            )

    def find(self, x: wp.array, clock: wp.array, counter: wp.array) -> None:
        """Move the collider to the start of the substep and list the particles near it."""
        wp.launch(
            move_collider, 1, inputs=[self._times, *self._path, clock, counter], outputs=[self._pose, self._totals],
            device=self._device,
        )  # fmt: skip
        wp.launch(forget_near, 1, inputs=[self._candidates, self._near, self._turn], device=self._device)
        group = 1 if self._threads > 1 else _GROUP
        wp.launch(
            sift, -(-self._count // group),
            inputs=[group, self._count, int(self._plane), wp.float64(self._reach), self._pose, x],
            outputs=[self._candidates], device=self._device,
        )  # fmt: skip
        model = [
            wp.vec3d(*self._half), self._relief, wp.float64(self._sight),
            wp.float64(_LEAVING), wp.float64(_FASTEST * self._cell), clock, self._turn,
        ]  # fmt: skip
        wp.launch(
            find_near, self._threads, inputs=[self._threads, *self._shape, *model, self._pose, x, self._candidates],
            outputs=[self._last, self._near, self._contact, self._drive, self._impulse, self._totals],
            device=self._device,
        )  # fmt: skip

    def press(self, x: wp.array, box: wp.array, velocity: wp.array, seen: wp.array, again: bool) -> None:
        """One turn of every near particle.

        Args:
            x: particles [m], (3P,).
            box: the grid's box on the device.
            velocity: of the grid's nodes [m/s], changed, (n,) vec4.
            seen: room for a copy of the velocities where all particles act at once.
            again: with the last substep's impulses.
        """
        relaxation = _RELAXATION if self.at_once else 1.0
        if self.at_once:
            wp.copy(seen, velocity)
        grid = [wp.vec3d(*self._lattice.origin), wp.vec3d(*(1.0 / self._lattice.spacing)), box]
        wp.launch(
            press, self._threads,
            inputs=[self._threads, self._friction, relaxation, int(again), *grid, x, self._near, self._contact,
                    self._drive, seen if self.at_once else velocity],
            outputs=[self._impulse, velocity, self._totals, self._hardest], device=self._device,
        )  # fmt: skip


def press_all(
    contacts: tuple[GridContact, ...], x: wp.array, box: wp.array, velocity: wp.array, seen: wp.array
) -> None:
    """All contacts of a substep: the last impulses first, then one correction each, from which the next goes on.

    Args:
        contacts: those of the problem, in the order of its terms.
        x, box, velocity, seen: as in :meth:`GridContact.press`.
    """
    for again in (True, False):
        for contact in contacts:
            contact.press(x, box, velocity, seen, again)
