"""Planning: how near a plan brings the object to its goal when the twin executes it, for a rope and for a soft body.

    python -m benchmarks.paper.planning [--json FILE] [--docs FILE] [--goals N] [--seed N]

On each sample scene the twin is calibrated, demonstrates, and trains a small world model; nothing is fine-tuned. Goals
are states that the twin can reach, which no plan has seen:

* ``bring``: all points of the free half where they hang after a slow move to a random place; to be reached in 1.5 s and
  held there over the last fifth;
* ``reach``: the free end where a random wild motion has it at its last moment;
* ``shape``: a goal of the first kind as a cloud without order (Chamfer distance).

MPPI plans with the model only. Every motion is then executed in the twin; the error is the mean distance to the goal
over the settling ticks. Beside it: the grips do not move; and the grips move in a straight line, smoothly, by the mean
displacement that the goal asks of its points.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.harness import Report, write_json, write_section
from physworld.calibrate.global_stage import CalibrationConfig, calibrate
from physworld.demonstrate import DemonstrationConfig, derived_seed, make_episode
from physworld.planning.goals import Goal, GoalPoints, GoalShape
from physworld.planning.mppi import Found, MppiConfig, coloured_noise, search
from physworld.planning.task import PlanningTask
from physworld.worldmodel.dataset import read_track
from physworld.worldmodel.model.config import TrainingConfig, WorldModelConfig
from physworld.worldmodel.scene_view import view_scene
from physworld.worldmodel.training import train
from physworld_scenes.bundle import read_bundle

ROOT = Path(__file__).resolve().parents[2]
SCENES = {"rope": "hanging_rope", "soft body": "soft_beam"}
IMAGES = ROOT / "docs" / "images"
HORIZON, SLOW_HORIZON = 45, 150
MODEL = WorldModelConfig(hidden=32, message_passing_steps=7, vertices=60)
TRAINING = TrainingConfig(steps=120)
EPISODES, SIMULATIONS, PARTICLES = 60, 40, 800
SEARCH = MppiConfig(horizon=HORIZON, samples=384, iterations=8)
REACH = MppiConfig(horizon=HORIZON, samples=384, iterations=8, settle=0.05)


@dataclass(frozen=True)
class Case:
    """One goal with what came of it; errors [m] in the twin, ``predicted`` in the model."""

    kind: str
    goal: Goal
    config: MppiConfig
    found: Found
    paths: dict[str, np.ndarray]
    errors: dict[str, float]
    predicted: float
    model_against_twin: float
    seconds: float


def measure(goals: int, seed: int) -> tuple[Report, dict[str, tuple[PlanningTask, list[Case]]]]:
    """Both scenes: the report, and the cases for pictures."""
    torch.set_num_threads(1)
    wp.config.quiet = True
    figures: dict[str, Any] = {}
    rows, cases = [], {}
    for name, folder in SCENES.items():
        task, learned = learn(ROOT / "sample" / folder, seed)
        found = [
            plan(task, kind, seed + 100 * k) for kind in ("bring", "reach", "shape") for k in range(goals)
        ]
        cases[name] = (task, found)
        figures[name.replace(" ", "_")] = {"model": learned} | {
            kind: _summary([case for case in found if case.kind == kind])
            for kind in ("bring", "reach", "shape")
        }
        rows += [_row(name, case) for case in found]
    report = Report(
        name="planning",
        title="Plans executed in the twin",
        figures=figures,
        header=(
            "scene",
            "goal",
            "no motion [mm]",
            "straight line [mm]",
            "plan [mm]",
            "predicted [mm]",
            "model against twin [mm]",
            "search [s]",
        ),
        rows=rows,
        notes=(
            f"Horizon {HORIZON} ticks, {SEARCH.samples} motions in each of {SEARCH.iterations} iterations, one thread; "
            f"world model of width {MODEL.hidden}, trained on {EPISODES} episodes; limits are the recording's.",
            "The straight line moves the grips by what the goal asks of its points on average: it knows the goal, but "
            "not how the body swings.",
            "Predicted is the model's error to the goal, model against twin the mean distance of both paths under the "
            "plan.",
        ),
        seed=seed,
    )
    return report, cases


def learn(folder: Path, seed: int) -> tuple[PlanningTask, dict[str, float]]:
    """A sample's twin and world model as a planning task, and what they cost and err."""
    started = time.perf_counter()
    scene = read_bundle(folder)
    twin = calibrate(scene, CalibrationConfig(particle_budget=PARTICLES, max_simulations=SIMULATIONS)).twin
    view = view_scene(scene, twin, MODEL)
    demonstration = DemonstrationConfig(frames=100)
    tracks = [
        read_track(
            view.spec, make_episode(scene, twin, demonstration, derived_seed(seed, k))[0], MODEL.history
        )
        for k in range(EPISODES)
    ]
    trained = train(tracks, view.spec, MODEL, TRAINING)
    phi = np.zeros((view.spec.object_count, 2))
    task = PlanningTask.of(view.published(trained.model, phi, phi), twin, scene)
    return task, {
        "open_loop_m": trained.best_error_m,
        "static_m": trained.static_error_m,
        "best_step": trained.best_step,
        "seconds": time.perf_counter() - started,
    }


def plan(task: PlanningTask, kind: str, seed: int) -> Case:
    """Make a goal of this kind, plan for it, execute everything in the twin."""
    generator = np.random.default_rng(seed)
    config = REACH if kind == "reach" else SEARCH
    goal, wanted = make_goal(task, kind, generator)
    started = time.perf_counter()
    found = search(task.predict, goal, task.limits, task.dt_s, config, generator)
    seconds = time.perf_counter() - started
    motions = {
        "none": np.zeros_like(found.displacements),
        "straight": straight(task, wanted, config),
        "plan": found.displacements,
    }
    paths = {name: task.execute(motion) for name, motion in motions.items()}
    ending = slice(-config.settling, None)
    errors = {name: float(goal.distance(path[ending]).mean()) for name, path in paths.items()}
    gap = float(np.linalg.norm(found.points - paths["plan"], axis=-1).mean())
    return Case(kind, goal, config, found, paths, errors, found.distance_m, gap, seconds)


def make_goal(task: PlanningTask, kind: str, generator: np.random.Generator) -> tuple[Goal, np.ndarray]:
    """A goal that the twin reaches, and the mean displacement (3,) [m] that it asks of its points."""
    start, limits = task.start_points, task.limits
    hold = np.mean([task.model.start_controllers[-1][grip].mean(axis=0) for grip in task.grips], axis=0)
    far = np.argsort(np.linalg.norm(start - hold, axis=1))
    if kind == "reach":
        noise = coloured_noise(generator, (1, HORIZON, len(limits.centres_m), 3), 2.0)
        wild = task.dt_s * limits.kept(0.7 * limits.speed_m_s * noise, task.dt_s)[0].cumsum(axis=0)
        index = far[-max(1, len(far) // 6) :]
        places = task.execute(wild)[-1, index]
        return GoalPoints(index, places), (places - start[index]).mean(axis=0)
    shift = generator.uniform(0.6 * limits.box_min_m[0], 0.6 * limits.box_max_m[0])
    slow = smooth(SLOW_HORIZON - 60, SLOW_HORIZON)[:, None, None] * shift
    end = task.execute(np.repeat(slow, len(limits.centres_m), axis=1))[-1]
    if kind == "shape":
        return GoalShape(end), (end - start).mean(axis=0)
    index = far[len(far) // 2 :]
    return GoalPoints(index, end[index]), (end[index] - start[index]).mean(axis=0)


def straight(task: PlanningTask, wanted: np.ndarray, config: MppiConfig) -> np.ndarray:
    """Grips (T, G, 3) in a line by ``wanted`` (3,), smoothly until the settling ticks, cut to the limits."""
    share = smooth(config.horizon - config.settling, config.horizon)
    path = np.repeat(share[:, None, None] * wanted, len(task.grips), axis=1)
    return task.dt_s * task.limits.kept(np.diff(path, axis=0, prepend=0.0) / task.dt_s, task.dt_s).cumsum(
        axis=0
    )


def smooth(moving: int, ticks: int) -> np.ndarray:
    """Share of a way after each of ``ticks``, done after ``moving`` of them: the quintic of least jerk."""
    s = np.clip(np.arange(1, ticks + 1) / moving, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def draw(cases: dict[str, tuple[PlanningTask, list[Case]]], folder: Path) -> list[Path]:
    """A picture a scene: where every first goal of a kind lies, and where each motion ends."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    written = []
    for name, (task, found) in cases.items():
        firsts = [next(case for case in found if case.kind == kind) for kind in ("bring", "reach", "shape")]
        figure, axes = pyplot.subplots(1, 3, figsize=(9.6, 3.4), constrained_layout=True)
        for axis, case in zip(axes, firsts, strict=True):
            _panel(axis, task, case)
        axes[0].legend(loc="best", fontsize=6.5, framealpha=0.8)
        figure.suptitle(f"{name}: end of the motion in the twin", fontsize=10)
        path = folder / f"planning_{name.replace(' ', '_')}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110, metadata={"Software": None})
        pyplot.close(figure)
        written.append(path)
    return written


def _panel(axis: Any, task: PlanningTask, case: Case) -> None:
    goal = case.goal.places if isinstance(case.goal, GoalPoints) else case.goal.shape  # type: ignore[attr-defined]
    side = int(np.argmax(np.ptp(np.concatenate([goal, task.start_points])[:, :2], axis=0)))
    looks = (
        ("none", "no motion", "0.65", "."),
        ("straight", "straight line", "tab:orange", "."),
        ("plan", "plan", "tab:blue", "."),
    )
    for key, label, colour, marker in looks:
        points = case.paths[key][-1]
        text = f"{label}: {1e3 * case.errors[key]:.0f} mm"
        axis.plot(points[:, side], points[:, 2], marker, color=colour, markersize=4, label=text)
    axis.plot(goal[:, side], goal[:, 2], "o", mfc="none", mec="black", markersize=6, label="goal")
    grips = (
        task.model.start_controllers[-1][np.concatenate(task.grips)].mean(axis=0)
        + case.found.displacements[:, 0]
    )
    axis.plot(grips[:, side], grips[:, 2], "-", color="tab:green", linewidth=1, label="grip, planned")
    errors = ", ".join(f"{1e3 * case.errors[key]:.0f}" for key in ("none", "straight", "plan"))
    axis.set_title(f"{case.kind}: {errors} mm", fontsize=9)
    axis.set_xlabel(f"{'xy'[side]} [m]", fontsize=8)
    axis.set_ylabel("z [m]", fontsize=8)
    axis.tick_params(labelsize=7)
    axis.set_aspect("equal", adjustable="datalim")


def _summary(cases: list[Case]) -> dict[str, Any]:
    keys = ("none", "straight", "plan")
    return {
        "error_m": {key: float(np.mean([case.errors[key] for case in cases])) for key in keys},
        "each_m": {key: [case.errors[key] for case in cases] for key in keys},
        "predicted_m": [case.predicted for case in cases],
        "model_against_twin_m": [case.model_against_twin for case in cases],
        "samples": cases[0].found.samples,
        "seconds": [case.seconds for case in cases],
    }


def _row(name: str, case: Case) -> list[str]:
    lengths = [case.errors[key] for key in ("none", "straight", "plan")]
    lengths += [case.predicted, case.model_against_twin]
    return [name, case.kind, *(f"{1e3 * length:.1f}" for length in lengths), f"{case.seconds:.0f}"]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper.planning", description=__doc__)
    parser.add_argument("--json", type=Path, default=None, help="write all figures there")
    parser.add_argument("--docs", type=Path, default=None, help="replace the section of this Markdown file")
    parser.add_argument("--goals", type=int, default=2, help="goals of each kind (default: 2)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    report, cases = measure(given.goals, given.seed)
    print(report.markdown())
    if given.json is not None:
        write_json(report, given.json)
    if given.docs is not None:
        write_section(report, given.docs)
        for path in draw(cases, IMAGES):
            print(f"drawn: {path}")


if __name__ == "__main__":
    main()
