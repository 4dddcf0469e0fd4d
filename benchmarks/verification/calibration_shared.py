"""``physworld fit`` in one process and with its simulations shared by two: seconds, and whether the answers agree."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.harness import Report

SCENES = {"d02": "undeclared/d02", "beam_free_a": "real/beam_free_a"}
PROCESSES = (1, 2)
ROUNDS = 2
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
TIMED = ("seconds",)  # keys of an answer that differ from run to run


def shared(seed: int, recordings: Path, resume: Path | None = None) -> Report:
    """The command itself, round after round with every number of processes in turn."""
    del resume  # a step that is kept is not timed
    figures: dict[str, Any] = {}
    rows = []
    for name, place in SCENES.items():
        taken: dict[int, list[float]] = {processes: [] for processes in PROCESSES}
        answers = []
        for _ in range(ROUNDS):
            for processes in PROCESSES:
                seconds, answer = timed_fit(recordings / place, processes)
                taken[processes].append(seconds)
                answers.append(_untimed(answer))
        one, two = (statistics.median(taken[processes]) for processes in PROCESSES)
        same = all(answer == answers[0] for answer in answers)
        figures[name] = {
            "seconds": {str(processes): values for processes, values in taken.items()},
            "speedup": one / two,
            "same_answer": same,
        }
        rows.append([name, f"{one:.1f}", f"{two:.1f}", f"{one / two:.2f}", "yes" if same else "NO"])
    return Report(
        name="calibration",
        title="A fit shared by two processes",
        figures=figures,
        header=["recording", "one process, s", "two, s", "ratio", "the same answer"],
        rows=rows,
        notes=[
            f"`physworld fit` from its start to its end (kernels were compiled before), its numerics included; "
            f"median of {ROUNDS} rounds in turn. Shared are starts, descents side by side, Jacobians, folds, finer "
            "cells and half a time step; a process that would wait runs what a descent will likely ask for next. Not "
            "shared are a descent's step after its step, runs that keep an account of their energy, and the start of "
            "two more Python processes.",
        ],
        seed=seed,
    )


def timed_fit(scene: Path, processes: int) -> tuple[float, dict[str, Any]]:
    """Seconds of the command and its answer."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "fit.json"
        command = [sys.executable, "-m", "physworld_workers.commands.fit", str(scene), "--json", str(answer)]
        begun = time.perf_counter()
        subprocess.run(
            [*command, "--processes", str(processes)],
            check=True,
            capture_output=True,
            env={**os.environ, **ONE_THREAD},
        )
        return time.perf_counter() - begun, json.loads(answer.read_text())


def _untimed(value: Any) -> Any:
    """An answer without what a clock put into it."""
    if isinstance(value, dict):
        return {key: _untimed(inner) for key, inner in value.items() if key not in TIMED}
    return [_untimed(inner) for inner in value] if isinstance(value, list) else value
