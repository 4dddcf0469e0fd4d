"""A GPU beside one thread of the CPU in the same machine: simulation, training, pictures.

Episodes are demonstrations of the sample scene, as the data factory draws them. On the GPU they run alone and side by
side; on the CPU alone, in one thread, as the service's workers run them. A training step is the loss of the default
settings and its gradient; on the GPU operation by operation, and recorded as one graph. Times are of the wall clock.
Run it where a CUDA device is: ``python -m benchmarks.speed.cuda``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
import warp as wp

from benchmarks.harness import Report, Timing, interleave, run_alone
from benchmarks.speed.batch import demonstrations, run_together
from benchmarks.speed.held_bar import held_bar, held_bar_sequence
from benchmarks.speed.video import HEIGHT, VERTICES, WIDTH, ball, shell
from physworld.engine.total.batch import Batch
from physworld.engine.total.formulation import TotalLagrangian
from physworld.twin.integration import Integration
from physworld.twin.twin import Twin
from physworld.video import GaussianCarrier, Renderer, orbit_view
from physworld.worldmodel.loss import GraphedLoss, plain_loss

GPU = "cuda:0"
BUDGETS = (2_000, 20_000)
WIDTHS = (16, 64, 256)
FRAMES, EPISODES = 6, 8
HIDDENS = (64, 128)
BATCH, LOOK_AHEAD = 6, 24
SPLATS = (20_000, 200_000)
MOST_SIDE_BY_SIDE = 1_000_000  # particles


def measure(repeats: int, seed: int) -> Report:
    """Everything on both devices, in turn."""
    wp.config.quiet = True
    torch.set_num_threads(1)
    figures: dict[str, object] = {"gpu": torch.cuda.get_device_name(0)}
    rows: list[list[str]] = []
    for part in (_simulations, _trainings, _pictures):
        found, lines = part(repeats, seed)
        figures |= found
        rows += lines
    return Report(
        name="cuda",
        title="A GPU beside one thread of its machine's CPU",
        figures=figures,
        header=("what", "size", "case", "time", "times the CPU's speed"),
        rows=rows,
        notes=[
            f"The GPU is one {figures['gpu']}.",
            f"Simulation: {FRAMES} frames of {EPISODES} demonstrations of `sample/soft_beam` with their set-up, time "
            "an episode. Side by side all take the smallest time step.",
            "One body of this size alone keeps a GPU waiting: a substep is three launches. Episodes of a dataset are "
            "made 16 side by side there.",
            f"Training: the loss of {BATCH} sub-sequences of {LOOK_AHEAD} steps and its gradient.",
        ],
        seed=seed,
    )


def _simulations(repeats: int, seed: int) -> tuple[dict[str, object], list[list[str]]]:
    rows, figures = [], {}
    for budget in BUDGETS:
        here, runs = demonstrations(budget, seed, FRAMES, EPISODES)
        there = [replace(run, problem=replace(run.problem, device=GPU)) for run in runs]
        particles = len(here.particles_start)
        cases: dict[str, Callable[[], float]] = {}
        cases["CPU, alone"] = lambda runs=runs, twin=here: _alone(twin, runs[:1])
        cases["GPU, alone"] = lambda runs=there, twin=here: _alone(twin, runs[:1])
        for width in WIDTHS:
            if width * particles <= MOST_SIDE_BY_SIDE:
                cases[f"GPU, {width} side by side"] = lambda runs=there, twin=here, width=width: _together(
                    twin, runs, width
                )
        for case in cases.values():
            case()
        rows += _rows("an episode", f"{particles} particles", cases, repeats, figures, 1e3, "ms")
    return figures, rows


def _alone(twin: Twin, runs: list[Integration]) -> float:
    started = time.perf_counter()
    for run in runs:
        TotalLagrangian(run.problem).run(twin.body.start, run.velocity, run.held, run.knots)
    return (time.perf_counter() - started) / len(runs)


def _together(twin: Twin, runs: list[Integration], width: int) -> float:
    taken = [runs[index % len(runs)] for index in range(width)]
    started = time.perf_counter()
    run_together(Batch([run.problem for run in taken]), twin, taken)
    return (time.perf_counter() - started) / width


def _trainings(repeats: int, seed: int) -> tuple[dict[str, object], list[list[str]]]:
    rows, figures = [], {}
    for hidden in HIDDENS:
        model, spec = held_bar(hidden, seed)
        start, driven, phi = held_bar_sequence(spec, seed, 4 + LOOK_AHEAD)
        frames = np.concatenate([np.repeat(start[-1:], len(driven), axis=0), driven], axis=1)
        whole = torch.as_tensor(frames, dtype=torch.float32)[:, :, None].repeat(1, 1, BATCH, 1)
        parts = whole[:4], whole[4:], torch.as_tensor(phi, dtype=torch.float32)[:, None]
        parts = *parts[:2], parts[2].repeat(1, BATCH, 1)
        there, recorded = held_bar(hidden, seed)[0].to(GPU), GraphedLoss()
        cases = {
            "CPU": lambda model=model, parts=parts: _timed(lambda: plain_loss(model, *parts).item()),
            "GPU, operation by operation": lambda model=there, parts=parts: _timed(
                lambda: plain_loss(model, *parts).item()
            ),
            "GPU, as one graph": lambda model=there, parts=parts, loss=recorded: _timed(
                lambda: loss(model, *parts).item()
            ),
        }
        for case in cases.values():
            case()
        rows += _rows("a training step", f"width {hidden}", cases, repeats, figures, 1e3, "ms")
    return figures, rows


def _pictures(repeats: int, seed: int) -> tuple[dict[str, object], list[list[str]]]:
    rows, figures = [], {}
    rng = np.random.default_rng(seed)
    rest = ball(VERTICES, rng)
    camera = orbit_view(1.2 * rest, width=WIDTH, height=HEIGHT)
    for size in SPLATS:
        splat, _ = GaussianCarrier(shell(size, rng), rest).at(rest)
        renderers = {"CPU": Renderer(camera, device="cpu"), "GPU": Renderer(camera, device=GPU)}
        pictures = {name: renderer.render(splat).rgb for name, renderer in renderers.items()}
        figures[f"pictures differ, {size}"] = float(np.abs(pictures["CPU"] - pictures["GPU"]).max())
        cases = {
            name: lambda renderer=renderer, splat=splat: _timed(lambda: renderer.render(splat))
            for name, renderer in renderers.items()
        }
        rows += _rows("a picture", f"{size} Gaussians", cases, repeats, figures, 1e3, "ms")
    return figures, rows


def _timed(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def _rows(
    what: str,
    size: str,
    cases: dict[str, Callable[[], float]],
    repeats: int,
    figures: dict[str, object],
    factor: float,
    unit: str,
) -> list[list[str]]:
    """The table's lines of one size; the first case is the CPU's, where it was run."""
    timings: dict[str, Timing] = interleave(cases, repeats)
    first = next(iter(timings))
    base = timings[first].median if first.startswith("CPU") else None
    rows = []
    for name, timing in timings.items():
        ratio = "" if base is None else f"{base / timing.median:.2f}"
        figures[f"{what}, {size}, {name}"] = timing.median
        rows.append(
            [what, size, name, f"{factor * timing.median:.3g} ± {factor * timing.spread:.2g} {unit}", ratio]
        )
        print(*rows[-1], file=sys.stderr, flush=True)
    return rows


if __name__ == "__main__":
    run_alone(measure)
