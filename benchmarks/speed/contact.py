"""What contact costs a solid on a table: without contact, as it runs, and with every point looked at every substep.

A soft block slides over the ground. Looking at every point is what a collider asks for that moves; a ground in two
equal poses is one. The time step that Gershgorin's bound on contact would ask for is printed beside the one taken.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import warp as wp

from benchmarks.harness import Report, interleave, run_alone
from benchmarks.verification.cases import GRAVITY, hold, nowhere, rest_nodes
from physworld.engine.lattice.lattice import box_lattice
from physworld.engine.problem import Problem
from physworld.engine.terms.colliders import Collider
from physworld.engine.terms.colliders_path import RigidPath
from physworld.engine.terms.contact import ColliderContact, GroundContact, contact_surface
from physworld.engine.total.formulation import TotalLagrangian
from physworld.engine.total.stability import stable_time_step
from physworld.materials.neo_hookean import NeoHookean
from physworld.shapes import sdf

SIZE_M, CELLS = np.array([0.14, 0.1, 0.07]), (10, 7, 5)
LAW = NeoHookean(2e4, 0.35, density_kg_m3=400.0)
FRICTION, SPEED_M_S = 0.5, 0.5
TIMES = np.linspace(0.0, 0.5, 16)
LATTICE = box_lattice(np.zeros(3), SIZE_M, CELLS)


def cases() -> dict[str, TotalLagrangian]:
    """Solvers by what is asked of contact."""
    rest = rest_nodes(LATTICE)
    twice = RigidPath(np.array([0.0, 1.0]), np.zeros((2, 3)), np.stack([np.eye(3)] * 2))
    terms = {
        "none": (),
        "as it runs": (GroundContact(0.0, FRICTION),),
        "all points": (ColliderContact(Collider("ground", sdf.half_space(), twice, FRICTION)),),
    }
    return {
        name: TotalLagrangian(Problem(LATTICE, LAW, rest, GRAVITY, terms=acting))
        for name, acting in terms.items()
    }


def gershgorin_step_s(free: TotalLagrangian) -> float:
    """The time step with Gershgorin's bound on contact."""
    surface = contact_surface(LATTICE, LAW)
    matrix = LATTICE.interpolation(surface.points)
    share = max(
        float((matrix.T @ np.where(surface.groups == group, surface.measures, 0.0) / free.mass).max())
        for group in np.unique(surface.groups)
    )
    return stable_time_step(float(np.sqrt(free.steps.frequency_rad_s**2 + surface.stiffness * share)), 0.0)


def measure(repeats: int, seed: int) -> Report:
    """All three in turn. Nothing in it is random."""
    wp.config.quiet = True
    solvers = cases()
    timings = interleave({name: _run(solver) for name, solver in solvers.items()}, repeats)
    former = gershgorin_step_s(solvers["none"])
    figures = {}
    rows = []
    for name, solver in solvers.items():
        substeps = sum(solver.substeps_of(step) for step in np.diff(TIMES))
        each = timings[name].median / substeps
        figures[name] = {
            "time_step_s": solver.time_step_s,
            "us_per_substep": 1e6 * each,
            "seconds": timings[name].median,
        }
        rows.append(
            [name, f"{1e3 * solver.time_step_s:.3f}", f"{1e6 * each:.0f} ± {1e6 * timings[name].spread / substeps:.0f}",
             f"{timings[name].median / timings['none'].median:.2f}"]
        )  # fmt: skip
    taken = solvers["as it runs"].time_step_s
    before = timings["all points"].median * taken / former
    figures["speedup"] = {
        "looking": timings["all points"].median / timings["as it runs"].median,
        "step": taken / former,
        "both": before / timings["as it runs"].median,
    }
    return Report(
        name="contact",
        title="A block on a table",
        figures=figures,
        header=["contact", "time step, ms", "a substep, µs", "a run, over one without contact"],
        rows=rows,
        notes=(
            f"{LATTICE.fill.size} particles, {len(contact_surface(LATTICE, LAW).points)} contact points; without "
            "contact the block falls.",
            f"Looking only at points that may touch: {figures['speedup']['looking']:.2f} times as fast, to the same "
            f"bit (test). Gershgorin's bound would ask for a step of {1e3 * former:.3f} ms, {taken / former:.2f} times "
            "shorter, more where cells are filled in part. Both together, were every substep as long as now: "
            f"{figures['speedup']['both']:.2f} times.",
        ),
        seed=seed,
    )


def _run(solver: TotalLagrangian) -> Callable[[], float]:
    rest = solver.problem.rest
    held = hold(nowhere(), rest, len(TIMES))
    slide = np.broadcast_to(np.array([SPEED_M_S, 0.0, 0.0]), rest.shape)

    def case() -> float:
        begun = time.perf_counter()
        solver.run(rest, np.array(slide), held, TIMES)
        return time.perf_counter() - begun

    return case


if __name__ == "__main__":
    run_alone(measure)
