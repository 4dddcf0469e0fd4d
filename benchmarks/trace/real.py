"""``python -m benchmarks.trace.real --json FILE``: what a trace says of measured objects.

Every case fits some recordings, or the first part of one, and is measured on recordings and frames that were not used:
the effects that the data support with their posteriors, the share of the held-out error that they remove, and what
remains. The noise is what each recording declares, that of its cameras. Where an experiment was repeated the two
recordings also say how well it repeats, and the case is run again with that as the noise.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Report, describe_machine, write_section
from physworld.calibrate import CalibrationConfig, Journal
from physworld.errors import PhysworldError
from physworld.scene import Scene
from physworld.trace import Memory, TraceConfig, Workers, document, trace
from physworld.trace.recordings import HELD_OUT
from physworld_scenes.bundle import read_bundle

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
BUDGET = 200
_MOVED = 0.05  # share of the whole motion that marks the release


@dataclass(frozen=True)
class Case:
    """What is fitted, what is held out, frames a second that are kept (None: all) and seconds of each (None: all)."""

    name: str
    fitted: tuple[str, ...]
    held_out: tuple[str, ...] = ()
    every: int = 1
    seconds: float | None = None
    repeats: tuple[str, str] | None = None


CASES = (
    Case("beam", ("beam_free_a",), ("beam_free_b", "beam_load52"), every=2, seconds=3.0),
    Case("beam, noise of the repeat", ("beam_free_a",), ("beam_free_b", "beam_load52"), every=2, seconds=3.0,
         repeats=("beam_free_a", "beam_free_b")),
    Case("beam, free and loaded", ("beam_free_a", "beam_load52"), ("beam_free_b",), every=2, seconds=3.0,
         repeats=("beam_free_a", "beam_free_b")),
    Case("noodle, gentle", ("noodle_gentle",), ("noodle_hard",), every=4, seconds=10.0),
    Case("noodle, both", ("noodle_gentle", "noodle_hard"), every=4, seconds=10.0),
    Case("rope, whipped", ("rope_a_whip",), ("rope_a_ring",), every=2),
    Case("rope, shaken", ("rope_c_shake",)),
    Case("cloth, swung", ("cloth_swing",)),
    Case("rope, shaken up and down", ("rope_b_shake",)),
    Case("branched cable", ("branched_a",)),
    Case("arm", ("arm_200mbar",), every=2),
)  # fmt: skip


def read(name: str, case: Case, folder: Path) -> Scene:
    """A recording, thinned and cut as the case says; its split keeps its shares."""
    scene = read_bundle(folder / name)
    end = scene.frame_count
    if case.seconds is not None:
        end = int(np.searchsorted(scene.times, case.seconds, side="right"))
    kept = np.arange(0, end, case.every)
    share = scene.train[1] / scene.frame_count
    last = round(share * len(kept))
    ctrl = scene.control_times is not None
    return replace(
        scene,
        points=scene.points[kept],
        visible=scene.visible[kept],
        controllers=scene.controllers[kept],
        times=scene.times[kept],
        train=(0, last),
        test=(last, len(kept)),
        fps=scene.fps / case.every if scene.fps else scene.fps,
        # the grips keep the rate at which they were measured
        control_times=scene.control_times if ctrl else scene.times[:end],
        control_points=scene.control_points if ctrl else scene.controllers[:end],
    )


def repeatability(first: Scene, second: Scene) -> float:
    """How well an experiment repeats [m]: each recording's share of their difference, per axis, aligned at the release.

    Displacements from the first frame are compared over the common time; the root mean square of their difference over
    the square root of two is one recording's share.
    """
    moves = []
    for scene in (first, second):
        moved = scene.points - scene.points[0]
        size = np.linalg.norm(moved, axis=2).mean(axis=1)
        start = scene.times[int(np.argmax(size > _MOVED * size.max()))]
        moves.append((scene.times - start, moved))
    (t1, m1), (t2, m2) = moves
    common = t1[(t1 >= 0) & (t1 <= t2[-1])]
    both = [
        np.stack([np.interp(common, t, m[:, n, i]) for n in range(m.shape[1]) for i in range(3)], axis=1)
        for t, m in ((t1, m1), (t2, m2))
    ]
    return float(np.sqrt(np.mean((both[0] - both[1]) ** 2) / 2.0))


def run(case: Case, folder: Path, memory: Path | None, processes: int, minutes: float) -> dict[str, Any]:
    """The figures of one case, traced by so many processes within about so many minutes."""
    fitted, unseen = ([read(n, case, folder) for n in names] for names in (case.fitted, case.held_out))
    if case.repeats is not None:
        sigma = repeatability(*(read(name, case, folder) for name in case.repeats))
        fitted, unseen = ([replace(s, noise_sigma_m=sigma) for s in many] for many in (fitted, unseen))
    config = TraceConfig(
        calibration=CalibrationConfig(particle_budget=BUDGET, damping="none"),
        experiment=None,
        time_limit_s=60.0 * minutes,
    )
    known = (
        Memory(memory / case.name.replace(", ", "-").replace(" ", "_")) if memory is not None else Memory()
    )
    journal = None
    if memory is not None:
        stored = memory / f"{case.name}.calibration.json"
        journal = Journal(
            repr((case, config.calibration)),
            stored.read_text() if stored.exists() else None,
            stored.write_text,
        )
    begun, cpu = time.perf_counter(), _cpu_s()
    with Workers(processes) as runner:
        report = document(
            trace(fitted, config, held_out=unseen, runner=runner, memory=known, journal=journal)
        )
    kept = (
        "verdict",
        "reason",
        "effects",
        "equivalent",
        "recordings",
        "calibrated",
        "remainder",
        "unexplained",
    )
    return {
        "case": case.name,
        **{key: report[key] for key in kept},
        "noise_m": report["held_out"]["noise_floor"],
        "misfit_before": report["training"]["misfit_before"],
        "misfit_after": report["training"]["misfit_after"],
        "numerics": report["training"]["numerics"],
        "candidates": report["candidates"][:6],
        "hypotheses": report["hypotheses"][:6],
        "simulations": report["simulations"],
        "wall_s": time.perf_counter() - begun,
        "cpu_s": _cpu_s() - cpu,
    }


def _cpu_s() -> float:
    """Processor time of this process and of those that have ended [s]."""
    known = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(used.ru_utime + used.ru_stime for used in known)


def page(rows: list[dict[str, Any]]) -> Report:
    """One line a recording."""
    table = []
    for row in rows:
        for k, known in enumerate(row["recordings"]):
            what = "not used" if known["role"] == HELD_OUT else "its last part"
            table.append(
                [
                    row["case"] if k == 0 else "",
                    _answer(row) if k == 0 else "",
                    f"{row['misfit_before']:.3g} to {row['misfit_after']:.3g}" if k == 0 else "",
                    f"{known['scene']} ({what})",
                    _mm(known["noise_floor"]),
                    _mm(known["before"]),
                    _mm(known["after"]) if row["effects"] else "-",
                    _mm(min(v for v in known["baselines"].values() if v is not None)),
                    f"{row['simulations']} in {row['cpu_s']:.0f} s" if k == 0 else "",
                ]
            )
    notes = [f"{row['case']}: {row['reason']}. {_posterior(row)}{_left(row)}" for row in rows]
    return Report(
        name="trace_real",
        title="Measured objects",
        figures={"cases": rows},
        header=["fitted", "answer", "misfit / noise", "measured on", "noise", "before", "after", "best baseline",
                "simulations, CPU"],
        rows=table,
        notes=[
            "Errors in mm, root mean square per axis, open loop, on recordings or frames that no step has seen. "
            "After: with what is named. Best baseline: the best of static, rigid follow and constant velocity.",
            *notes,
            *_not_run(rows),
        ],
    )  # fmt: skip


def _posterior(row: dict[str, Any]) -> str:
    """The sets that hold the posterior, with the strengths of the first."""
    known = [
        f"{' + '.join(h['effects']) or 'declared physics'} {h['posterior']:.2f}"
        for h in row["hypotheses"]
        if h["posterior"] >= 0.01
    ]
    numbers = [
        f"{name} {n['value']:.3g} {n['unit']}" for e in row["effects"] for name, n in e["parameters"].items()
    ]
    return f"Posterior: {', '.join(known)}. " + (f"{', '.join(numbers)}. " if numbers else "")


def _left(row: dict[str, Any]) -> str:
    left = row["remainder"]
    if left["share"] is None or left["over_noise"] is None:
        return f"What remains: {left['description']}."
    return (
        f"What remains: {left['share']:.0%} of the error before, {1e3 * left['rms_m']:.3g} mm, "
        f"{left['over_noise']:.3g} times the noise; {left['description']}."
    )


def _not_run(rows: list[dict[str, Any]]) -> list[str]:
    missing = [case.name for case in CASES if case.name not in {row["case"] for row in rows}]
    return [f"Not run yet: {'; '.join(missing)}."] if missing else []


def _answer(row: dict[str, Any]) -> str:
    names = " + ".join(effect["name"] for effect in row["effects"])
    others = ", ".join(effect["name"] for effect in row["equivalent"])
    return row["verdict"] + (f": {names}" if names else "") + (f" (or {others})" if others else "")


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.3g}"


def main() -> int:
    """Run the cases, write what there is after each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trace.real", description=__doc__)
    parser.add_argument(
        "--json", type=Path, required=True, help="all figures; cases that it has are not run again"
    )
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    parser.add_argument("--only", nargs="*", default=[], help="names of cases; none: all")
    parser.add_argument("--resume", type=Path, default=None, help="folder that remembers simulations")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--time-limit", type=float, default=10.0, help="minutes a case; as the command has it"
    )
    parser.add_argument("--set", type=Path, default=SHARED, help="folder of the recordings")
    given = parser.parse_args()
    if not (given.set / "beam_free_a" / "scene.json").exists():
        print(f"no recordings in {given.set}", file=sys.stderr)
        return 1
    if given.resume is not None:
        given.resume.mkdir(parents=True, exist_ok=True)
    done = {}
    if given.json.exists():
        done = {row["case"]: row for row in json.loads(given.json.read_text())["cases"]}
    for case in CASES:
        if case.name not in done and (not given.only or case.name in given.only):
            try:
                found = run(case, given.set, given.resume, given.processes, given.time_limit)
                done[case.name] = json.loads(json.dumps(found, default=float))
            except PhysworldError as failure:
                print(f"{case.name}: {type(failure).__name__}: {failure}", file=sys.stderr)
                continue
            print(json.dumps(done[case.name]), flush=True)
        rows = [done[c.name] for c in CASES if c.name in done]
        given.json.write_text(json.dumps({"cases": rows, "machine": describe_machine()}, indent=2) + "\n")
    if given.docs is not None:
        write_section(page([done[c.name] for c in CASES if c.name in done]), given.docs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
