"""What an effect costs: a substep with it over a substep without, on a beam, a sheet and a rope, one thread.

Every effect of the registry at its probe, each on its own, at the same forced time step. A substep is all of it: the
law's forces, the effect's, grips, the nodes' step. The thread's own processor time is taken. What an effect does to the
stable time step is shown apart.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import warp as wp

from benchmarks.harness import Report, interleave, run_alone
from physworld.effects.base import Effect
from physworld.effects.registry import EFFECTS, effect
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.formulation import TotalLagrangian
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin
from physworld_workers.commands.effects import everyday_scenes

PARTICLES = 2000
SUBSTEPS = {"solid": 400, "sheet": 800, "rod": 4000}
DT_SHARE = (
    0.3  # of the plain engine's own time step: stable for every effect, and the cost does not depend on it
)


def measure(repeats: int, seed: int) -> Report:
    """Every effect on every body that takes it. Nothing in it is random."""
    wp.config.quiet = True
    figures: dict[str, dict[str, dict[str, float]]] = {}
    for body, scene in everyday_scenes().items():
        twin = build_twin(scene, PARTICLES)
        plain = _problem(twin)[0]
        step = TotalLagrangian(plain).time_step_s
        cases = {"none": _substep(*_problem(twin), twin, DT_SHARE * step, SUBSTEPS[body])}
        steps = {"none": 1.0}
        for name, kind in EFFECTS.items():
            if kind.refuses(twin) is not None or kind.kind == "measurement":
                continue
            gates = {s.name: s.probe for s in kind.strengths(twin) if s.gate}
            problem, held = _problem(twin, effect(name, **gates))
            steps[name] = TotalLagrangian(problem).time_step_s / step
            cases[name] = _substep(
                problem, held, twin, DT_SHARE * min(1.0, steps[name]) * step, SUBSTEPS[body]
            )
        for case in cases.values():
            case()  # compiles
        times = interleave(cases, repeats)
        for name, timing in times.items():
            ratio = timing.median / times["none"].median
            figures.setdefault(name, {})[body] = {"ratio": ratio, "time_step": steps[name]}
    bodies = list(SUBSTEPS)
    rows = [
        [
            name,
            *(
                f"{found[b]['ratio']:.2f} ({found[b]['time_step']:.2f})" if b in found else "–"
                for b in bodies
            ),
        ]
        for name, found in figures.items()
        if name != "none"
    ]
    return Report(
        name="effects",
        title="Effects: a substep with one over a substep without",
        figures=figures,
        header=["effect at its probe", *bodies],
        rows=rows,
        notes=[
            "1 is free; in brackets the stable time step over the one without the effect. Processor time, one thread.",
            "Measurement effects act after the run.",
        ],
        seed=seed,
    )


def _problem(twin: Twin, added: Effect | None = None) -> tuple[Problem, HeldNodes]:
    """The twin's problem under still grips over one interval."""
    problem = Problem(twin.lattice, twin.law, twin.body.rest, twin.gravity_m_s2, terms=twin.contacts)
    gripped = twin
    if added is not None:
        problem, gripped = added.problem(problem, twin), added.grips(twin)
    nodes = np.concatenate(gripped.held_nodes)
    still = np.repeat(gripped.body.start[nodes][None], 2, axis=0)
    held = HeldNodes(nodes, still, np.zeros_like(still))
    return (problem, held) if added is None else added.attach(problem, held, twin)


def _substep(problem: Problem, held: HeldNodes, twin: Twin, dt: float, substeps: int) -> Callable[[], float]:
    engine = TotalLagrangian(problem, dt)
    times = np.array([0.0, substeps * dt])

    def run() -> float:
        engine.substeps = 0
        start = time.thread_time()
        engine.run(twin.body.start, np.zeros_like(twin.body.start), held, times)
        return 1e9 * (time.thread_time() - start) / engine.substeps

    return run


if __name__ == "__main__":
    run_alone(measure)
