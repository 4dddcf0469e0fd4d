"""What strong internal friction costs: explicit at the step that it leaves, and in sub-steps of its own.

Bodies are clamped at one end and let go from level under gravity; their friction is chosen so that an explicit step
would be 10, 30 and 100 times smaller than without it. The two ways run in turn; where they part is the largest distance
of a node from its place in the explicit run, over the way of the farthest node.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import warp as wp

from benchmarks.harness import Report, interleave, run_alone
from benchmarks.verification.cases import GRAVITY, clamped_lattice, gripped, hold, rest_nodes
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.problem import Problem
from physworld.engine.total.formulation import Run, TotalLagrangian
from physworld.materials.laws import Law
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw

SHRINK = (10.0, 30.0, 100.0)
SECONDS, FRAMES = 0.06, 4
BODIES: dict[str, tuple[Lattice, Law, str]] = {
    "solid": (
        clamped_lattice(0.3, (0.06, 0.06), (19, 4, 4)),
        NeoHookean(2e5, 0.3, density_kg_m3=600.0),
        "viscosity_pa_s",
    ),
    "sheet": (
        clamped_lattice(0.2, (0.2,), (20, 20)),
        SheetLaw(300.0, 1e-2, density_kg_m2=0.5),
        "relaxation_s",
    ),
    "rod": (clamped_lattice(0.5, (), (100,)), RodLaw(50.0, 2e-2, density_kg_m=0.05), "relaxation_s"),
}


def with_shrink(lattice: Lattice, law: Law, name: str, shrink: float) -> Problem:
    """The body whose friction makes an explicit step ``shrink`` times smaller."""
    rest = rest_nodes(lattice)
    probe = TotalLagrangian(
        Problem(lattice, replace(law, **{name: 1.0}), rest, GRAVITY), friction="explicit"
    ).steps
    rate = (shrink - 1.0 / shrink) * probe.frequency_rad_s
    return Problem(lattice, replace(law, **{name: rate / probe.internal_per_s}), rest, GRAVITY)


def measure(repeats: int, seed: int) -> Report:
    """All bodies at all strengths. Nothing in it is random."""
    wp.config.quiet = True
    figures: dict[str, dict[str, dict[str, float]]] = {}
    rows = []
    times = np.linspace(0.0, SECONDS, FRAMES)
    for body, (lattice, law, name) in BODIES.items():
        figures[body] = {}
        for shrink in SHRINK:
            problem = with_shrink(lattice, law, name, shrink)
            ways = {
                "relaxed": TotalLagrangian(problem),
                "explicit": TotalLagrangian(problem, friction="explicit"),
            }
            ends: dict[str, np.ndarray] = {}
            timings = interleave({way: _run(ways[way], times, ends, way) for way in ways}, repeats)
            substeps = {way: _substeps(solver, times) for way, solver in ways.items()}
            way = float(np.linalg.norm(ends["explicit"] - problem.rest, axis=1).max())
            found = {
                "step_ratio": ways["relaxed"].time_step_s / ways["explicit"].time_step_s,
                "stages": float(_stages(ways["relaxed"], times)),
                "substeps_relaxed": float(substeps["relaxed"]),
                "substeps_explicit": float(substeps["explicit"]),
                "speedup": timings["explicit"].median / timings["relaxed"].median,
                "apart": float(np.linalg.norm(ends["relaxed"] - ends["explicit"], axis=1).max()) / way,
            }
            figures[body][f"{shrink:g}"] = found
            rows.append(
                [
                    f"{body}, {lattice.fill.size} particles",
                    f"{found['step_ratio']:.0f}",
                    f"{substeps['explicit']}",
                    f"{substeps['relaxed']} × {found['stages']:.0f}",
                    f"{found['speedup']:.1f}",
                    f"{found['apart']:.1e}",
                ]
            )
    return Report(
        name="friction",
        title="Strong internal friction",
        figures=figures,
        header=[
            "body", "step without friction over explicit step", "explicit substeps", "substeps × stages", "speedup",
            "apart",
        ],
        rows=rows,
        notes=(
            "The same motion with explicit friction, and with friction in Runge-Kutta-Legendre stages within the step "
            "that the elastic forces allow; wall times of whole runs, in turn.",
            "Apart: largest distance between the two runs at their end, over the way of the farthest node.",
        ),
        seed=seed,
    )  # fmt: skip


def _run(
    solver: TotalLagrangian, times: np.ndarray, ends: dict[str, np.ndarray], way: str
) -> Callable[[], float]:
    problem = solver.problem
    held = hold(gripped(problem.lattice), problem.rest, len(times))

    def case() -> float:
        begun = time.perf_counter()
        ends[way] = solver.run(problem.rest, np.zeros_like(problem.rest), held, times)[-1]
        return time.perf_counter() - begun

    return case


def _substeps(solver: TotalLagrangian, times: np.ndarray) -> int:
    return sum(solver.substeps_of(step) for step in np.diff(times))


def _stages(solver: TotalLagrangian, times: np.ndarray) -> int:
    problem = solver.problem
    held = hold(gripped(problem.lattice), problem.rest, len(times))
    run = Run(solver, problem.rest, np.zeros_like(problem.rest), held, times)
    run.advance(0)
    return run.stages


if __name__ == "__main__":
    run_alone(measure)
