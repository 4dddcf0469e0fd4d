"""Episodes side by side against one after another: ns per particle and substep, one thread of a CPU.

The episodes are demonstrations of the sample scene, as the data factory draws them: other motions, other property
fields. Times are the process's own CPU time, so that what else runs on the machine counts little. A case is
taken apart: the set-up (binding, the search for the stable time step), and the run (capture, substeps, one look at the
state a frame). Side by side all take the smallest of the episodes' time steps; what that costs is in the whole
episode's time, not in the time of a substep.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from benchmarks.harness import Report, interleave, run_alone
from physworld.demonstrate import DemonstrationConfig, derived_seed, plan_episode
from physworld.engine.total.batch import Batch
from physworld.engine.total.formulation import TotalLagrangian
from physworld.twin.build import build_twin
from physworld.twin.integration import Integration
from physworld.twin.twin import Twin
from physworld_scenes.bundle import read_bundle

SCENE = Path(__file__).resolve().parents[2] / "sample" / "soft_beam"
BUDGETS = (500, 2000)
WIDTHS = (1, 4, 16)
EPISODES = max(WIDTHS)
FRAMES = 40


@dataclass
class Spent:
    """CPU time of a case in one round.

    Attributes:
        setup_s, run_s: summed over the episodes.
        particle_substeps: integrated in all.
    """

    setup_s: float = 0.0
    run_s: float = 0.0
    particle_substeps: int = 0


def measure(repeats: int, seed: int) -> Report:
    """The same episodes alone and in batches of each width, in turn, at every budget."""
    wp.config.quiet = True
    figures: dict[str, dict[str, object]] = {}
    rows = []
    for budget in BUDGETS:
        twin, runs = demonstrations(budget, seed)
        particles = len(twin.particles_start)
        spent: dict[str, list[Spent]] = {}
        cases: dict[str, Callable[[], float]] = {
            name: _episode_seconds(name, twin, runs, width, spent)
            for name, width in {"alone": 0, **{f"batch_{width}": width for width in WIDTHS}}.items()
        }
        for case in cases.values():
            case()  # compiles and warms the caches
        spent.clear()
        seconds = interleave(cases, repeats)
        steps = Batch([run.problem for run in runs]).time_steps_s
        sizes: dict[str, object] = {"particles": particles, "episodes": EPISODES, "frames": FRAMES}
        sizes["time_step_mean_over_least"] = float(steps.mean() / steps.min())
        for name in cases:
            substep = [1e9 * one.run_s / one.particle_substeps for one in spent[name]]
            setup = [1e3 * one.setup_s / EPISODES for one in spent[name]]
            whole = seconds["alone"].median / seconds[name].median
            sizes[name] = {
                "ns_per_particle_substep": float(np.median(substep)),
                "setup_ms_per_episode": float(np.median(setup)),
                "ms_per_episode": 1e3 * seconds[name].median,
                "ms_per_episode_spread": 1e3 * seconds[name].spread,
                "episodes_against_alone": whole,
            }
            rows.append(
                [
                    f"{particles}",
                    name.replace("batch_", "side by side, "),
                    f"{np.median(substep):.1f}",
                    f"{np.median(setup):.1f}",
                    f"{1e3 * seconds[name].median:.0f} ± {1e3 * seconds[name].spread:.0f}",
                    f"{whole:.2f}",
                ]
            )
        figures[f"{budget}"] = sizes
    least = {budget: figures[f"{budget}"]["time_step_mean_over_least"] for budget in BUDGETS}
    return Report(
        name="batch",
        title="Episodes side by side on a CPU, one thread",
        figures=figures,
        header=[
            "particles", "case", "ns per particle-substep", "set-up, ms an episode", "CPU ms an episode",
            "episodes a second, to alone",
        ],
        rows=rows,
        notes=[
            f"{EPISODES} demonstrations of `sample/soft_beam`, {FRAMES} frames each, the same in every case; CPU time "
            "of the process, medians over rounds in turn.",
            "Side by side all take the smallest time step: the mean of those that they would take alone is "
            + ", ".join(f"{ratio:.2f} times it at {budget}" for budget, ratio in least.items())
            + " particles.",
            "Every episode gives the same numbers as alone at that time step, bit for bit "
            "(`tests/unit/engine/test_batch.py`). On a GPU: [below](#a-gpu-beside-one-thread-of-its-machines-cpu).",
        ],
        seed=seed,
    )  # fmt: skip


def demonstrations(
    budget: int, seed: int, frames: int = FRAMES, episodes: int = EPISODES
) -> tuple[Twin, list[Integration]]:
    """A twin of the sample scene on the CPU and its episodes, planned and not yet run."""
    scene = read_bundle(SCENE)
    twin = build_twin(scene, budget, device="cpu")
    config = DemonstrationConfig(frames=frames, replay_share=0.0)
    plans = [plan_episode(scene, twin, config, derived_seed(seed, index)) for index in range(episodes)]
    runs = [
        twin.integration(
            plan.control_times, plan.control_points, plan.times, properties=plan.properties, from_rest=True
        )
        for plan in plans
    ]
    return twin, runs


def run_together(engine: Batch, twin: Twin, runs: list[Integration]) -> None:
    """The episodes of an engine that has been set up for them. Raises what one of them raised."""
    ended = engine.run(
        [twin.body.start] * len(runs),
        [run.velocity for run in runs],
        [run.held for run in runs],
        [run.knots for run in runs],
    )
    for nodes in ended:
        if not isinstance(nodes, np.ndarray):
            raise nodes


def _episode_seconds(
    name: str, twin: Twin, runs: list[Integration], width: int, spent: dict[str, list[Spent]]
) -> Callable[[], float]:
    """CPU seconds an episode: all of them, ``width`` side by side (0: the engine of one body); keeps the parts."""

    def case() -> float:
        parts = Spent()
        for first in range(0, EPISODES, max(width, 1)):
            taken = runs[first : first + max(width, 1)]
            began = time.process_time()
            engine: Batch | TotalLagrangian
            if width:
                engine = Batch([run.problem for run in taken])
            else:
                engine = TotalLagrangian(taken[0].problem)
            ready = time.process_time()
            if isinstance(engine, Batch):
                run_together(engine, twin, taken)
            else:
                engine.run(twin.body.start, taken[0].velocity, taken[0].held, taken[0].knots)
            parts.run_s += time.process_time() - ready
            parts.setup_s += ready - began
            parts.particle_substeps += engine.substeps * len(taken) * len(twin.particles_start)
        spent.setdefault(name, []).append(parts)
        return (parts.setup_s + parts.run_s) / EPISODES

    return case


if __name__ == "__main__":
    run_alone(measure)
