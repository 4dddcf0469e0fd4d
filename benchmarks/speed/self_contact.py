"""What self-contact costs: a rope and a sheet of 2000 particles that touch nothing, and a coil and a fold at rest.

The same body runs with and without it, in turn, at the time step that it needs: a substep's cost apart from the number
of substeps. Free bodies lie still, or move by waves that have the pairs sought again and again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from benchmarks.harness import Report, interleave, run_alone
from benchmarks.verification.cases import GRAVITY, rest_nodes
from benchmarks.verification.contact import CLOTH, NOBODY, still
from physworld.engine.lattice.lattice import box_lattice
from physworld.engine.problem import Problem
from physworld.engine.terms.contact import GroundContact
from physworld.engine.thin.self_contact import BoundSelfContact, SelfContact
from physworld.engine.total.formulation import TotalLagrangian
from physworld.materials.rod import RodLaw

ROPE = RodLaw(stretching_n=200.0, bending_n_m2=1e-4, relaxation_s=2e-3, density_kg_m=0.05)
_WAVE_M_S, _WAVE_LENGTHS = 0.2, 4


@dataclass(frozen=True)
class Scenario:
    """A body with self-contact as its last term, its start, and how long it runs [s]."""

    problem: Problem
    nodes: np.ndarray
    velocity: np.ndarray
    seconds: float


def free(dim: int, moving: bool) -> Scenario:
    """2000 particles far from each other, at rest or in waves."""
    size, counts = (np.array([10.0]), (1000,)) if dim == 1 else (np.full(2, 0.3), (22, 23))
    lattice = box_lattice(np.zeros(dim), size, counts)
    law, thickness = (ROPE, 0.008) if dim == 1 else (CLOTH, 1e-3)
    rest = rest_nodes(lattice)
    velocity = np.zeros_like(rest)
    if moving:
        velocity[:, 2] = _WAVE_M_S * np.sin(2 * np.pi * _WAVE_LENGTHS * rest[:, 0] / size[0])
    return Scenario(
        Problem(lattice, law, rest, GRAVITY, terms=(SelfContact(thickness, 0.3),)), rest, velocity, 0.1
    )


def coil() -> Scenario:
    """A coil of rope that has fallen on itself."""
    length, radius, pitch, diameter = 1.0, 0.04, 0.06, 0.012
    lattice = box_lattice(np.zeros(1), np.array([length]), (64,))
    turn = lattice.node_coordinates[:, 0] / np.hypot(radius, pitch / (2 * np.pi))
    start = np.stack(
        [radius * np.cos(turn), radius * np.sin(turn), pitch / (2 * np.pi) * turn + 0.02], axis=1
    )
    ground = GroundContact(0.0, 0.5, 0.5 * diameter)
    terms = (ground, SelfContact(diameter, 0.3))
    return _settled(
        Problem(lattice, ROPE, rest_nodes(lattice), GRAVITY, drag_per_s=2.0, terms=terms), start, 0.8
    )


def fold() -> Scenario:
    """A sheet that lies on itself."""
    thickness, low, radius = 2e-3, 0.12, 0.02
    lattice = box_lattice(np.zeros(2), np.array([0.3, 0.1]), (24, 8))
    along, start = lattice.node_coordinates[:, 0], rest_nodes(lattice)
    angle = np.clip((along - low) / radius, 0, np.pi)
    start[:, 0] = (
        np.minimum(along, low) + radius * np.sin(angle) - np.maximum(along - low - np.pi * radius, 0)
    )
    start[:, 2] = radius * (1 - np.cos(angle)) + 0.5 * thickness
    terms = (GroundContact(0.0, 0.5, 0.5 * thickness), SelfContact(thickness, 0.3))
    return _settled(
        Problem(lattice, CLOTH, rest_nodes(lattice), GRAVITY, drag_per_s=2.0, terms=terms), start, 0.4
    )


def _settled(problem: Problem, start: np.ndarray, seconds: float) -> Scenario:
    times = np.array([0.0, seconds])
    nodes = TotalLagrangian(problem).run(start, 0 * start, still(NOBODY, start, 2), times)[-1]
    return Scenario(problem, nodes, 0 * nodes, 0.02)


SCENARIOS: dict[str, Callable[[], Scenario]] = {
    "rope, at rest": lambda: free(1, False),
    "rope, in waves": lambda: free(1, True),
    "sheet, at rest": lambda: free(2, False),
    "sheet, in waves": lambda: free(2, True),
    "coil of rope on the ground": coil,
    "folded sheet on the ground": fold,
}


def measure(repeats: int, seed: int) -> Report:
    """All bodies with and without self-contact. Nothing in it is random."""
    wp.config.quiet = True
    figures, rows = {}, []
    for name, scenario in SCENARIOS.items():
        case = scenario()
        bare = replace(case.problem, terms=case.problem.terms[:-1])
        touching, alone = TotalLagrangian(case.problem), TotalLagrangian(bare)
        same_step = TotalLagrangian(bare, touching.time_step_s)
        timings = interleave({"with": _run(touching, case), "without": _run(same_step, case)}, repeats)
        contact = touching.terms[-1]
        assert isinstance(contact, BoundSelfContact)
        substeps = touching.substeps_of(case.seconds)
        cost = {way: timing.median * 1e6 for way, timing in timings.items()}
        figures[name] = {
            **{f"us_per_substep_{way}": value for way, value in cost.items()},
            "step_ratio": alone.time_step_s / touching.time_step_s,
            "pairs": float(contact.pairs),
            "searches": float(contact.searches),
            "substeps": float(substeps),
        }
        rows.append(
            [
                name, f"{case.problem.lattice.fill.size:,}", f"{contact.pairs}", f"{contact.searches} of {substeps}",
                f"{cost['without']:.0f}", f"{cost['with']:.0f}", f"{alone.time_step_s / touching.time_step_s:.2f}",
            ]
        )  # fmt: skip
    return Report(
        name="self_contact",
        title="Self-contact",
        figures=figures,
        header=[
            "body", "particles", "pairs at the end", "searches of substeps", "without, µs a substep", "with",
            "time steps, without over with",
        ],
        rows=rows,
        notes=(
            "The same body with and without self-contact at the same time step, in turn; processor time of whole runs. "
            "The bodies on the ground begin where they lie with self-contact.",
            "Pairs: of places that are followed, nearer than the thickness and half a cell.",
        ),
        seed=seed,
    )  # fmt: skip


def _run(solver: TotalLagrangian, case: Scenario) -> Callable[[], float]:
    times = np.array([0.0, case.seconds])
    held = still(NOBODY, case.nodes, 2)

    def once() -> float:
        before, begun = solver.substeps, time.process_time()
        solver.run(case.nodes, case.velocity, held, times)
        return (time.process_time() - begun) / (solver.substeps - before)

    return once


if __name__ == "__main__":
    run_alone(measure)
