"""``python -m benchmarks.trace.power --json FILE``: what a trace can name, and what it names where nothing acts.

Every effect of the registry is injected at three strengths (1, 3 and 10 times the noise in displacement) into
recordings of a beam, a rope and a sheet; the effects that need a ground into a pad that lies on one. Recordings without
an effect, each with another motion, stiffness and noise, count the false names. The recordings come from cells 1.4
times smaller than the fit's. Nothing but the recording and what its scene declares reaches the trace, but for one
shortcut: it starts from a stiffness 30 % off the truth instead of a scan over decades, and searches from there.

Traces are independent. ``--resume DIR`` keeps each as a line of ``results.jsonl`` with the commit that it ran on, and a
later call goes on with those that are missing: recordings without an effect and the middle strengths first, so that a
partial run is a table already.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.harness import describe_machine, write_section
from benchmarks.trace.power_effects import LEVELS, inject, refusal
from benchmarks.trace.power_objects import GROUND_ONLY, NULLS_ONLY, OBJECTS, Object, observed, recorded
from benchmarks.trace.power_picture import draw, draw_calibration
from benchmarks.trace.power_report import page, summary
from physworld.effects.registry import EFFECTS
from physworld.errors import PhysworldError
from physworld.scene import Scene
from physworld.trace import Memory, TraceResult, document, trace
from physworld.twin.build import build_twin

NULLS = 120
METHOD = tuple(
    f"physworld/{room}"
    for room in ("trace", "calibrate", "estimation", "effects", "engine", "geometry", "evaluate", "twin")
)
_OFF = 1.3  # stiffness that a trace starts from, over the true one
_STIFFNESS = ("youngs_modulus_pa", "membrane_n_m", "bending_n_m", "bending_n_m2")


@dataclass(frozen=True)
class Task:
    """One trace: an object, an effect at a level (None and 0: none), a seed of motion, stiffness and noise."""

    object: str
    effect: str | None
    level: float
    seed: int

    @property
    def key(self) -> str:
        """Unique."""
        return f"{self.object}/{self.effect or 'none'}/{self.level:g}/{self.seed}"


def tasks(nulls: int, seed: int = 0) -> list[Task]:
    """All of them in their order: ``nulls`` recordings without an effect, motions and noise drawn from ``seed`` on."""
    bodies = [name for name in OBJECTS if name not in (GROUND_ONLY, NULLS_ONLY)]
    sources = [*bodies, *bodies, NULLS_ONLY]  # of recordings without an effect
    without = [Task(sources[k % len(sources)], None, 0.0, seed + 1 + k) for k in range(nulls)]
    low, middle, high = LEVELS
    injected = [
        Task(body, name, level, seed)
        for level in (middle, high, low)
        for body in (*_cheapest_first(bodies), GROUND_ONLY)
        for name in EFFECTS
        if body != GROUND_ONLY or _needs_ground(name)
    ]
    return without + injected


def _cheapest_first(bodies: list[str]) -> list[str]:
    return sorted(bodies, key=["rope", "beam", "sheet"].index)


def _needs_ground(name: str) -> bool:
    return name in ("ground_friction", "adhesion")


def run(task: Task, memory: Path | None = None) -> dict[str, Any]:
    """One line: what was injected, and what the trace said; ``memory`` keeps its simulations."""
    known = OBJECTS[task.object](task.seed)
    kept = Memory(memory / task.key.replace("/", "_")) if memory is not None else Memory()
    line: dict[str, Any] = asdict(task)
    without = observed(known.truth, known.scene)
    if task.effect is None:
        return line | traced(known, recorded(known.scene, without, task.seed), kept)
    reason = refusal(task.effect, known)
    if reason is not None:
        return line | {"outcome": "refused", "reason": reason}
    made = inject(task.effect, known, without, task.level)
    if made is None:
        return line | {"outcome": "refused", "reason": "no strength within the bounds can be simulated"}
    line |= {"strengths": made.strengths, "size": made.size, "unit": made.unit, "clipped": made.clipped}
    line |= {"displacement": made.displacement}
    noise_seed = 1000 + sorted(EFFECTS).index(task.effect)
    return line | traced(known, recorded(known.scene, made.tracks, noise_seed), kept)


def traced(known: Object, scene: Scene, memory: Memory | None = None) -> dict[str, Any]:
    """What a trace says of a recording, and its seconds."""
    start = build_twin(scene, known.budget)
    true = known.truth.parameters
    start = start.with_parameters(**{n: _OFF * true[n] for n in _STIFFNESS if n in true})
    begun, cpu = time.perf_counter(), time.process_time()
    try:
        found = trace(scene, known.config(), calibrated_twin=start, memory=memory)
    except (PhysworldError, RuntimeError) as failure:
        return {"outcome": "failed", "reason": f"{type(failure).__name__}: {failure}"}
    return _answer(found) | {
        "wall_s": time.perf_counter() - begun, "cpu_s": time.process_time() - cpu
    }  # fmt: skip


def _answer(found: TraceResult) -> dict[str, Any]:
    report = document(found)
    return {
        "outcome": report["verdict"],
        "reason": report["reason"],
        "names": [effect["name"] for effect in report["effects"]],
        "equivalent": [effect["name"] for effect in report["equivalent"]],
        "found": {
            effect["name"]: {key: number["value"] for key, number in effect["parameters"].items()}
            for effect in report["effects"]
        },
        "misfit_before": report["training"]["misfit_before"],
        "misfit_after": report["training"]["misfit_after"],
        "finer_cells": report["training"]["numerics"].get("finer cells"),
        "held_out_before_m": report["held_out"]["before"],
        "held_out_after_m": report["held_out"]["after"],
        "explained_fraction": report["held_out"]["explained_fraction"],
        "posterior": [[h["effects"], h["posterior"]] for h in report["hypotheses"][:4]],
        "simulations": report["simulations"],
    }


def commit() -> dict[str, Any]:
    """Commit of the method, and whether its files differ from it."""
    root = Path(__file__).resolve().parents[2]
    try:
        head = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=root, capture_output=True, text=True, check=True
        )
        same = subprocess.run(["git", "diff", "--quiet", "HEAD", "--", *METHOD], cwd=root, check=False)
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "changed": None}
    return {"commit": head.stdout.strip(), "changed": same.returncode != 0}


def stored(folder: Path | None) -> dict[str, dict[str, Any]]:
    """Lines by key; a line that was cut off is left out."""
    if folder is None or not (folder / "results.jsonl").exists():
        return {}
    lines: dict[str, dict[str, Any]] = {}
    for text in (folder / "results.jsonl").read_text().splitlines():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        lines[line["key"]] = line
    return lines


def _wanted(every: list[Task], only: list[str]) -> Iterator[Task]:
    for task in every:
        if not only or {task.object, task.effect or "none", task.key} & set(only):
            yield task


def main() -> int:
    """Run what is missing, then write what there is."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trace.power", description=__doc__)
    parser.add_argument("--json", type=Path, required=True, help="all figures")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    parser.add_argument("--resume", type=Path, default=None, help="folder that keeps every trace")
    parser.add_argument(
        "--memory",
        type=Path,
        default=None,
        help="folder that remembers simulations, for other rules of the trace",
    )
    parser.add_argument(
        "--only", nargs="*", default=[], help="objects, effects, 'none' or keys; none given: all"
    )
    parser.add_argument("--nulls", type=int, default=NULLS, help="recordings without an effect")
    parser.add_argument(
        "--at-most", type=int, default=None, help="traces to run now; 0: only write the report"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of motions, stiffnesses and noise: another is fresh"
    )
    given = parser.parse_args()
    every = tasks(given.nulls, given.seed)
    lines = stored(given.resume)
    missing = [task for task in _wanted(every, given.only) if task.key not in lines]
    version = commit()
    import warp as wp

    wp.config.quiet = True
    for task in missing[: given.at_most]:
        line = {"key": task.key, **run(task, given.memory), **version}
        line = json.loads(json.dumps(line, default=float))
        lines[task.key] = line
        if given.resume is not None:
            given.resume.mkdir(parents=True, exist_ok=True)
            with (given.resume / "results.jsonl").open("a") as file:
                file.write(json.dumps(line) + "\n")
        print(json.dumps(line), flush=True)
    asked = [task.key for task in every]
    rows = [lines[key] for key in asked if key in lines]
    figures = {**summary(rows, len(asked)), "traces": rows}
    given.json.parent.mkdir(parents=True, exist_ok=True)
    given.json.write_text(json.dumps({**figures, "machine": describe_machine()}, indent=2) + "\n")
    if given.docs is not None:
        images = given.docs.parent / "images"
        draw(rows, images / "trace_power.svg")
        draw_calibration(figures["calibration"], images / "trace_calibration.svg")
        pictures = ("images/trace_power.svg", "images/trace_calibration.svg")
        write_section(page(rows, figures, len(asked), pictures, given.seed), given.docs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
