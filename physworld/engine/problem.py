"""What a formulation integrates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from physworld.arrays import Array
from physworld.devices import default_device
from physworld.engine.hands import Hand
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.terms.term import Term
from physworld.materials.laws import Law

if TYPE_CHECKING:
    from physworld.engine.rods.discrete_rods import Sections


@dataclass(frozen=True)
class HeldNodes:
    """Nodes that gripped material touches: their numbers (H,) and their paths at the frames, (T, H, 3) [m], [m/s].

    ``hands``: those of the grips that let go and take hold again; the others hold all the time.
    """

    nodes: Array
    positions: Array
    velocities: Array
    hands: tuple[Hand, ...] = ()


@dataclass(frozen=True)
class Problem:
    """What a formulation integrates.

    Attributes:
        lattice, law: the reference body and its constitutive parameters.
        rest: nodal positions without stress, in the world [m], (n, 3).
        gravity_m_s2: (3,).
        drag_per_s: linear drag rate c of every node [1/s].
        stiffness_factor, density_factor: fields over the particles, (P,), or None for 1.
        friction_factor: of the ground under them, likewise.
        added_mass: lumped masses that hang from the nodes [kg], (n,), or None.
        terms: what else acts on the nodes, contacts and effects, in the order of their launches.
        span_s: first and last time of the run, for terms that change in time; None where nobody says.
        sections: of a discrete rod, what its sections do; None of other bodies.
    """

    lattice: Lattice
    law: Law
    rest: Array
    gravity_m_s2: Array
    drag_per_s: float = 0.0
    stiffness_factor: Array | None = None
    density_factor: Array | None = None
    added_mass: Array | None = None
    terms: tuple[Term, ...] = ()
    friction_factor: Array | None = None
    span_s: tuple[float, float] | None = None
    sections: Sections | None = None
    device: str = field(default_factory=default_device)

    def nodal_mass(self) -> Array:
        """Lumped nodal masses [kg], (n,)."""
        mass = nodal_mass(self.lattice, self.law, self.density_factor)
        return mass if self.added_mass is None else mass + self.added_mass


def nodal_mass(lattice: Lattice, law: Law, density_factor: Array | None) -> Array:
    """Lumped nodal masses [kg], (n,): rows of the mass matrix summed."""
    particle_mass = law.density * lattice.particle_measures
    if density_factor is not None:
        particle_mass = particle_mass * density_factor
    return lattice.lumped(particle_mass)
