"""The three ways to integrate a body, what each supports, and which one a body takes.

The total Lagrangian form does not damp, so it is taken wherever it can describe the motion. The updated Lagrangian
form is taken where material flows, parts, or touches itself: a flow law says so, or the scene does. A sheet has only
the total form, and touches itself there (:mod:`physworld.engine.thin.self_contact`); so does a rod that starts
straight. A rod that was measured has a curvature of its own, and is a discrete rod (:mod:`physworld.engine.rods`).

What a run returns are its *carriers*: the nodes of the lattice, in the updated form the particles.
Another form is a subclass of :class:`Formulation` and an entry of :data:`FORMULATIONS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from physworld.arrays import Array
from physworld.engine.lattice.following import follow
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.rods.discrete_rods import DiscreteRods
from physworld.engine.total.energy import EnergyLedger, run_with_ledger
from physworld.engine.total.formulation import TotalLagrangian, run_again_if_blown_up
from physworld.engine.updated.energy import ParticleLedger, run_particles_with_ledger
from physworld.engine.updated.formulation import UpdatedLagrangian
from physworld.engine.updated.transfer import TRANSFERS, Apic
from physworld.errors import SceneUnsupported, SimulationError
from physworld.materials.plastic import Plasticity

Ability = Literal["gradients", "batches", "soft_grips", "friction_field"]
Progress = Callable[[int, int], None]
_DECLARED = {"self_contact": "the body touches itself", "topology_change": "the body parts or merges"}


@dataclass(frozen=True)
class Course:
    """How a run begins, what holds the body, and when its carriers are asked for.

    Attributes:
        nodes, velocities: of the lattice at the first time, (n, 3) [m] and [m/s].
        particles: all particles there, those without material too, (P, 3) [m].
        held: prescribed nodes; their paths are given at ``times``.
        times: (T,) [s], strictly increasing.
    """

    nodes: Array
    velocities: Array
    particles: Array
    held: HeldNodes
    times: Array


class Formulation(ABC):
    """One way to integrate a body.

    Attributes:
        name: in archives, on the wire and on the command line.
        dimensions: of the bodies that it holds.
        on_particles: its carriers are the particles, not the nodes.
        fast: it runs hundreds of frames a second or more on one thread, so that a network beside it saves little time.
        abilities: what may be asked of its runs.
    """

    name: ClassVar[str]
    dimensions: ClassVar[frozenset[int]]
    on_particles: ClassVar[bool]
    fast: ClassVar[bool] = False
    abilities: ClassVar[frozenset[Ability]]

    @property
    def title(self) -> str:
        """For people."""
        return self.name.replace("_", " ")

    def supports(self, ability: Ability) -> bool:
        """Whether its runs have gradients, go side by side, take soft grips, or a field of the ground's friction."""
        return ability in self.abilities

    @abstractmethod
    def refuse(self, dimension: int, plasticity: Plasticity | None, asked: str) -> None:
        """Raises SceneUnsupported for a body of ``dimension`` or a flow law that it does not hold."""

    @abstractmethod
    def solver(
        self,
        problem: Problem,
        time_step_s: float | None = None,
        transfer: str = Apic.name,
        plasticity: Plasticity | None = None,
    ) -> Any:
        """What integrates a problem; the carriers come from :meth:`run`.

        Args:
            problem: the body and what acts on it.
            time_step_s: forced time step [s], or None for the stable one.
            transfer: how particles and grid exchange velocities; read by the updated form.
            plasticity: flow law; read by the updated form.

        Raises:
            CFLViolation: the forced time step exceeds the stable limit.
            SceneUnsupported: something that acts has no such form.
        """

    @abstractmethod
    def run(self, solver: Any, course: Course, progress: Progress | None = None) -> Array:
        """Carriers at the course's times, (T, n, 3) [m], by what :meth:`solver` made.

        ``progress`` is called with (frames done, frames in all) once a frame, and may raise to stop.

        Raises:
            SimulationError: the run cannot be trusted.
        """

    @abstractmethod
    def run_with_ledger(
        self, solver: Any, course: Course, progress: Progress | None = None
    ) -> tuple[Array, EnergyLedger | ParticleLedger]:
        """The same, and where every joule went; errors are those of :meth:`run`."""


class TotalForm(Formulation):
    """Nodes of splines about the undeformed body (:mod:`physworld.engine.total.formulation`)."""

    name = "total_lagrangian"
    dimensions = frozenset({1, 2, 3})
    on_particles = False
    abilities = frozenset({"gradients", "batches", "soft_grips", "friction_field"})

    def refuse(self, dimension: int, plasticity: Plasticity | None, asked: str) -> None:
        """Flow laws."""
        if plasticity is not None:
            raise SceneUnsupported(
                f"{plasticity.name} flow needs the updated Lagrangian form and a solid; asked was {asked} for a body "
                f"of dimension {dimension} (the plasticity effect covers small plastic strains)"
            )

    def solver(
        self,
        problem: Problem,
        time_step_s: float | None = None,
        transfer: str = Apic.name,
        plasticity: Plasticity | None = None,
    ) -> TotalLagrangian:
        """See the base class; neither transfer nor flow law is read.

        Args:
            problem, time_step_s, transfer, plasticity: as in :meth:`Formulation.solver`.
        """
        return TotalLagrangian(problem, time_step_s)

    def run(self, solver: TotalLagrangian, course: Course, progress: Progress | None = None) -> Array:
        """Nodes; once more at half the time step where the body blew up."""
        return run_again_if_blown_up(
            solver, course.nodes, course.velocities, course.held, course.times, progress
        )

    def run_with_ledger(
        self, solver: TotalLagrangian, course: Course, progress: Progress | None = None
    ) -> tuple[Array, EnergyLedger]:
        """Nodes and the ledger of the nodes."""
        return run_with_ledger(
            solver.problem, course.nodes, course.velocities, course.held, course.times,
            time_step_s=solver.asked_step_s, progress=progress,
        )  # fmt: skip


class UpdatedForm(Formulation):
    """Particles through a grid that forgets (:mod:`physworld.engine.updated.formulation`)."""

    name = "updated_lagrangian"
    dimensions = frozenset({3})
    on_particles = True
    abilities = frozenset()

    def refuse(self, dimension: int, plasticity: Plasticity | None, asked: str) -> None:
        """Sheets and rods."""
        if dimension not in self.dimensions:
            raise SceneUnsupported(
                f"the updated Lagrangian form integrates solids, the body has dimension {dimension}"
            )

    def solver(
        self,
        problem: Problem,
        time_step_s: float | None = None,
        transfer: str = Apic.name,
        plasticity: Plasticity | None = None,
    ) -> UpdatedLagrangian:
        """See the base class.

        Args:
            problem, time_step_s, transfer, plasticity: as in :meth:`Formulation.solver`.
        """
        return UpdatedLagrangian(problem, time_step_s, transfer=TRANSFERS[transfer](), plasticity=plasticity)

    def run(self, solver: UpdatedLagrangian, course: Course, progress: Progress | None = None) -> Array:
        """All particles."""
        solid = solver.run_particles(course.nodes, course.velocities, course.held, course.times, progress)
        return _with_empty(solver.solid, solid, course.particles)

    def run_with_ledger(
        self, solver: UpdatedLagrangian, course: Course, progress: Progress | None = None
    ) -> tuple[Array, ParticleLedger]:
        """All particles and their ledger."""
        solid, ledger = run_particles_with_ledger(
            solver, course.nodes, course.velocities, course.held, course.times, progress
        )
        return _with_empty(solver.solid, solid, course.particles), ledger


def _with_empty(numbers: Array, solid: Array, start: Array) -> Array:
    """All particles (T, P, 3) from those with material, their ``numbers`` and paths (T, len(numbers), 3).

    Where there is no material they go along with what is near; ``start`` (P, 3) has all of them at the first time.
    """
    particles = np.empty((len(solid), len(start), 3))
    particles[:, numbers] = solid
    empty = np.setdiff1d(np.arange(particles.shape[1]), numbers)
    if len(empty):
        particles[:, empty] = follow(start[empty], solid)
    return particles


class RodForm(Formulation):
    """Chains of edges with directors, whose rest shape is their own (:mod:`physworld.engine.rods.discrete_rods`)."""

    name = "discrete_rod"
    dimensions = frozenset({1})
    on_particles = False
    fast = True
    abilities = frozenset()

    def refuse(self, dimension: int, plasticity: Plasticity | None, asked: str) -> None:
        """Solids, sheets and flow laws."""
        if dimension not in self.dimensions or plasticity is not None:
            raise SceneUnsupported(
                f"a discrete rod is elastic and of dimension 1; the body has dimension {dimension} and its flow law is "
                f"{None if plasticity is None else plasticity.name}"
            )

    def solver(
        self,
        problem: Problem,
        time_step_s: float | None = None,
        transfer: str = Apic.name,
        plasticity: Plasticity | None = None,
    ) -> DiscreteRods:
        """See the base class; neither transfer nor flow law is read.

        Args:
            problem, time_step_s, transfer, plasticity: as in :meth:`Formulation.solver`.
        """
        return DiscreteRods([problem], time_step_s)

    def run(self, solver: DiscreteRods, course: Course, progress: Progress | None = None) -> Array:
        """Nodes."""
        found = solver.run(course.nodes, course.velocities, [course.held], course.times, progress)[0]
        if isinstance(found, SimulationError):
            raise found
        return found

    def run_with_ledger(
        self, solver: DiscreteRods, course: Course, progress: Progress | None = None
    ) -> tuple[Array, EnergyLedger]:
        """None is kept.

        Raises:
            SceneUnsupported: always.
        """
        raise SceneUnsupported(
            f"no energy ledger of a discrete rod of {len(solver.chain.parent)} nodes is kept"
        )


TOTAL, UPDATED, RODS = TotalForm(), UpdatedForm(), RodForm()
FORMULATIONS: dict[str, Formulation] = {form.name: form for form in (TOTAL, UPDATED, RODS)}


@dataclass(frozen=True)
class Choice:
    """A formulation and why it was taken."""

    formulation: Formulation
    reason: str


def choose_formulation(
    dimension: int,
    declared: dict[str, Any],
    plasticity: Plasticity | None = None,
    asked: str = "auto",
    own_shape: bool = False,
) -> Choice:
    """The formulation for a body.

    Args:
        dimension: 3 for a solid, 2 for a sheet, 1 for a rod.
        declared: the scene's declaration; ``body.self_contact`` and ``body.topology_change`` are read.
        plasticity: the body's flow law.
        asked: "auto", or the name of a formulation, which is then taken.
        own_shape: it is a rod whose rest shape nobody knows.

    Raises:
        ValueError: ``asked`` is no formulation.
        SceneUnsupported: the updated Lagrangian form is asked for a sheet or a rod, or a flow law for the total one.
    """
    if asked != "auto" and asked not in FORMULATIONS:
        raise ValueError(f"no formulation is called {asked!r}; there are {list(FORMULATIONS)} and 'auto'")
    choice = (
        Choice(FORMULATIONS[asked], "asked for")
        if asked != "auto"
        else _best(dimension, declared, plasticity, own_shape)
    )
    choice.formulation.refuse(dimension, plasticity, asked)
    return choice


def _best(dimension: int, declared: dict[str, Any], plasticity: Plasticity | None, own_shape: bool) -> Choice:
    """What a body takes where nobody asks for a form."""
    if own_shape:
        return Choice(RODS, "a rod whose rest shape is not known: its curvature and twist need directors")
    if dimension not in UPDATED.dimensions:
        return Choice(TOTAL, f"a body of dimension {dimension} has no other form")
    if plasticity is not None:
        flow = f"its flow law is {plasticity.name}"
        return Choice(UPDATED, flow if plasticity.flows else "its law is that of a return mapping")
    body = declared.get("body") or {}
    for key, reason in _DECLARED.items():
        if body.get(key):
            return Choice(UPDATED, f"the scene declares {key}: {reason}")
    return Choice(TOTAL, "an elastic solid: no transfers, so none of their damping")
