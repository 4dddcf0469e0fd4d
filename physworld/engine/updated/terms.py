"""What acts on the particles of the updated Lagrangian form beside the law: contacts, forces and stresses of effects.

A term of a problem (:mod:`physworld.engine.terms.term`) names forces on a lattice's nodes. Where its force is one on
material it has a method ``on_particles`` that binds it to particles instead: the same launch with particles in the
place of nodes, whose forces kick the particles before they go to the grid,

    v_p += dt f_p / m_p

(momentum is kept to rounding), or a :class:`BoundParticleStress`, which changes the stress that goes to the grid.
Contacts with the ground and with colliders become :class:`~physworld.engine.updated.contact.GridContact`. All others
are refused by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.terms.contact import ColliderContact, GroundContact, ground
from physworld.engine.terms.term import BoundTerm, Term
from physworld.engine.updated.contact import GridContact
from physworld.engine.updated.grid_box import GridLattice
from physworld.errors import SceneUnsupported

if TYPE_CHECKING:
    from physworld.engine.problem import Problem


@dataclass(frozen=True)
class ParticleBody:
    """What a term may know of the particles.

    Attributes:
        problem: the body and all that acts on it.
        solid: numbers of the particles with material among the lattice's, (P,).
        mass: their masses [kg], (P,).
        padded: length of the arrays that are taken in groups, P or a few more.
        flows: a flow law forgets part of the deformation.
    """

    problem: Problem
    solid: Array
    mass: Array
    padded: int
    flows: bool


class BoundParticleStress:
    """A stress beside the law's whose arrays live on a device; the attributes are those of a :class:`BoundTerm`."""

    frequency_rad_s: float = 0.0
    friction_per_s: float = 0.0

    def begin(self, times: Array) -> None:
        """A run over the frames ``times`` (T,) [s] starts. May raise."""
        return None

    def launch(self, F: wp.array, stress: wp.array, clock: wp.array, counter: wp.array) -> None:
        """Change the stress of the particles.

        Args:
            F: deformation gradients, (P,) mat33d.
            stress: volume times Kirchhoff stress [J], (6P,); changed.
            clock: (frame interval [s], 1/dt [1/s], dt [s]).
            counter: (frame, substep, substeps).
        """
        raise NotImplementedError(f"{type(self).__name__} launches nothing")


class ParticleTerms:
    """The terms of a problem, bound to particles.

    Args:
        body: the particles.
        lattice: the grid.

    Attributes:
        contacts: of the ground and the colliders, in the order of the problem's terms.
        ground_height_m: of the ground, or None.
        frequency_rad_s, friction_per_s: what the terms add to the stable time step.

    Raises:
        SceneUnsupported: a term has no form on particles; the message names it.
    """

    def __init__(self, body: ParticleBody, lattice: GridLattice) -> None:
        problem, count = body.problem, len(body.solid)
        self._device, self._count = problem.device, count
        self.ground_height_m: float | None = None
        stiffest = 1.0 if problem.stiffness_factor is None else float(np.max(problem.stiffness_factor))
        modulus = problem.law.contact_stiffness(1.0)[0] * stiffest
        contacts: list[GridContact] = []
        bound: list[BoundTerm | BoundParticleStress] = []
        for term in problem.terms:
            if isinstance(term, GroundContact):
                plane = ground(term.height_m, term.friction)
                factor = problem.friction_factor
                friction = np.ones(count) if factor is None else factor[body.solid]
                contacts.append(GridContact(plane, lattice, friction, modulus, False, self._device))
                self.ground_height_m = term.height_m
            elif isinstance(term, ColliderContact):
                contacts.append(
                    GridContact(term.collider, lattice, np.ones(count), modulus, True, self._device)
                )
            else:
                bound.append(_on_particles(term, body))
        self.contacts = tuple(contacts)
        self._stresses = [term for term in bound if isinstance(term, BoundParticleStress)]
        self._forces = [term for term in bound if not isinstance(term, BoundParticleStress)]
        self._bound = bound
        self.frequency_rad_s = float(np.sqrt(sum(term.frequency_rad_s**2 for term in bound)))
        self.friction_per_s = float(sum(term.friction_per_s for term in bound))
        if self._forces:
            self._mass = wp.array(body.mass, dtype=wp.float64, device=self._device)
            self._velocity = wp.zeros(3 * count, dtype=wp.float64, device=self._device)
            self._force = wp.zeros(3 * count, dtype=wp.float64, device=self._device)

    def begin(self, times: Array, x: Array) -> None:
        """A run over the frames ``times`` (T,) [s] starts with particles at ``x`` (P, 3) [m]. May raise."""
        for term in self._bound:
            term.begin(times)
        for contact in self.contacts:
            contact.begin(times, x)

    def check(self, time_s: float, dt_s: float) -> None:
        """After substeps of ``dt_s``: a :class:`physworld.errors.SimulationError` where they cannot be trusted."""
        for term in self._forces:
            term.check(time_s)
        for contact in self.contacts:
            contact.check(time_s, dt_s)

    def launch(
        self, x: wp.array, v: wp.array, F: wp.array, stress: wp.array, clock: wp.array, counter: wp.array
    ) -> None:
        """Before particles go to the grid: change their stress, and kick their velocities.

        Args:
            x, v: positions [m] and velocities [m/s], (3P,); the velocities are changed.
            F: deformation gradients, (P,) mat33d.
            stress: volume times Kirchhoff stress [J], (6P,); changed.
            clock: (frame interval [s], 1/dt [1/s], dt [s]).
            counter: (frame, substep, substeps).
        """
        for stressing in self._stresses:
            stressing.launch(F, stress, clock, counter)
        if not self._forces:
            return
        size = 3 * self._count
        wp.launch(widen, size, inputs=[v], outputs=[self._velocity], device=self._device)
        for term in self._forces:
            term.launch(x, self._velocity, clock, counter, self._force)
        wp.launch(kick, size, inputs=[self._mass, clock], outputs=[self._force, v], device=self._device)


def _on_particles(term: Term, body: ParticleBody) -> Any:
    name = getattr(term, "name", type(term).__name__)
    bind = getattr(term, "on_particles", None)
    if bind is None:
        raise SceneUnsupported(
            f"{name} acts on the nodes of the reference lattice; the updated Lagrangian form has {len(body.solid)} "
            "particles and none of these nodes"
        )
    return bind(body)


@wp.kernel(enable_backward=False)
def widen(v: wp.array[wp.float32], velocity: wp.array[wp.float64]) -> None:
    """One component of the particles' velocities [m/s] in double precision, as forces read it."""
    k = wp.tid()
    velocity[k] = wp.float64(v[k])


@wp.kernel(enable_backward=False)
def kick(
    # model
    mass: wp.array[wp.float64],
    clock: wp.array[wp.float64],
    # in, cleared
    force: wp.array[wp.float64],
    # in, out
    v: wp.array[wp.float32],
) -> None:
    """One component of the velocity [m/s] after the force [N] of a substep."""
    k = wp.tid()
    v[k] = wp.float32(wp.float64(v[k]) + clock[2] * force[k] / mass[k // 3])
    force[k] = wp.float64(0.0)
