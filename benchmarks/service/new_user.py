"""A new user's times, from an empty folder: to the first held-out table, and to the first plot in a notebook.

``python -m benchmarks.service.new_user [--json FILE]``, from a clone whose `make wheels` works. Both begin with
nothing: an empty home (no package and no kernel is cached) and no environment of ours.

1. `git clone`, `make demo` (which installs) until the results table is printed.
2. An empty environment, `pip install` of the built wheels with what a notebook needs, and the guide's first notebook
   (docs/notebooks/recording_to_model.ipynb), which starts the service, fits, demonstrates and trains, until its first
   plot. Building the wheels is not the user's work and is not counted.

Packages come from the index that pip is set up with; how near that is decides much of both.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.harness import Report, run_alone

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = Path("docs/notebooks/recording_to_model.ipynb")
TABLE, INSTALLED, PLOT = "Held-out error of", "bootstrap: done", "image/png"
EXTRAS = {"physworld-": "[api,sim,train]", "physworld_client-": "[plot]"}
KERNEL = ("ipykernel", "nbclient")
MINE = ("PHYSWORLD_", "VIRTUAL_ENV", "PYTHONPATH", "XDG_", "WARP_", "MAKE", "MFLAGS", "MPL")
RUN_NOTEBOOK = """
import sys
import nbformat
from nbclient import NotebookClient

def ended(cell, cell_index, execute_reply):
    kinds = {kind for output in cell.get("outputs", []) for kind in output.get("data", {})}
    print("cell", cell_index, *sorted(kinds), flush=True)

book = nbformat.read(sys.argv[1], as_version=4)
where = {"metadata": {"path": sys.argv[2]}}
NotebookClient(book, timeout=3600, kernel_name="python3", resources=where, on_cell_executed=ended).execute()
"""


class StepFailed(RuntimeError):
    """A step of the new user's way ended with an error, or without the line that was waited for."""


@dataclass(frozen=True)
class Followed:
    """A command that ran to its end.

    Attributes:
        marks_s: from its start to the first line with each mark [s].
        lasted_s: wall time [s].
        cpu_s: of it and of its children [CPU s].
        load: of the machine at its end, the mean of a minute.
    """

    marks_s: Mapping[str, float]
    lasted_s: float
    cpu_s: float
    load: float


def follow(
    command: Sequence[str], folder: Path, environment: Mapping[str, str], marks: Sequence[str] = ()
) -> Followed:
    """Run a command and note when its output first says each of some marks.

    Args:
        command: with its arguments.
        folder: where it runs.
        environment: all of its variables.
        marks: parts of lines of its output.

    Raises:
        StepFailed: it failed, or ended without one of the marks; with its last lines.
    """
    begun, cpu = time.monotonic(), _children_cpu_s()
    found: dict[str, float] = {}
    lines: list[str] = []
    with subprocess.Popen(
        command,
        cwd=folder,
        env=dict(environment),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            for mark in marks:
                if mark in line:
                    found.setdefault(mark, time.monotonic() - begun)
    missing = [mark for mark in marks if mark not in found]
    if process.returncode or missing:
        said = f"without a line with {missing[0]!r}" if missing else f"with exit code {process.returncode}"
        raise StepFailed(f"{' '.join(command[:3])} ended {said}: {''.join(lines[-20:])}")
    load = os.getloadavg()[0]
    return Followed(found, time.monotonic() - begun, _children_cpu_s() - cpu, load)


def measure(repeats: int, seed: int) -> Report:
    """Both ways once; ``repeats`` is of no use here."""
    subprocess.run(["make", "--silent", "wheels", f"BIN={Path(sys.executable).parent}"], cwd=ROOT, check=True)
    steps: dict[str, Followed] = {}
    with tempfile.TemporaryDirectory(prefix="physworld-new-user-") as folder:
        base = Path(folder)
        steps["clone"] = follow(
            ["git", "clone", "--quiet", ROOT.as_uri(), "physworld"], base, fresh(base / "home")
        )
        steps["demo"] = follow(["make", "demo"], base / "physworld", fresh(base / "home"), (INSTALLED, TABLE))
    with tempfile.TemporaryDirectory(prefix="physworld-new-user-") as folder:
        base = Path(folder)
        steps |= _notebook(base, fresh(base / "home"))
    return _report(steps, seed)


def fresh(home: Path) -> dict[str, str]:
    """The variables of somebody whose home is empty; without those that lead to what is installed here."""
    home.mkdir(exist_ok=True)
    kept = {name: value for name, value in os.environ.items() if not name.startswith(MINE)}
    own = str(Path(sys.executable).parent)
    path = os.pathsep.join(part for part in kept["PATH"].split(os.pathsep) if part != own)
    return {**kept, "PATH": path, "HOME": str(home)}


def _notebook(base: Path, environment: Mapping[str, str]) -> dict[str, Followed]:
    """An empty environment, the wheels, and the guide's notebook beside the sample scene."""
    for part in (NOTEBOOK, Path("sample/soft_beam")):
        (base / part).parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (ROOT / part).is_dir() else shutil.copy)(ROOT / part, base / part)
    wheels = [
        str(max((ROOT / "dist").glob(f"{name}*.whl"), key=lambda wheel: wheel.stat().st_mtime)) + extras
        for name, extras in EXTRAS.items()
    ]
    python = str(base / "venv" / "bin" / "python")
    made = follow([sys.executable, "-m", "venv", "venv"], base, environment)
    pip = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *wheels, *KERNEL]
    installed = follow(pip, base, environment)
    book = [python, "-c", RUN_NOTEBOOK, str(base / NOTEBOOK), str((base / NOTEBOOK).parent)]
    return {"venv": made, "pip": installed, "notebook": follow(book, base, environment, (PLOT,))}


def _report(steps: Mapping[str, Followed], seed: int) -> Report:
    clone, demo, pip, book = (steps[name] for name in ("clone", "demo", "pip", "notebook"))
    table_s = clone.lasted_s + demo.marks_s[TABLE]
    plot_s = pip.lasted_s + book.marks_s[PLOT]
    figures: dict[str, Any] = {
        "clone_to_table_s": table_s,
        "pip_to_plot_s": plot_s,
        "steps": {name: vars(step) for name, step in steps.items()},
    }
    ways = [
        ("`git clone`", clone.lasted_s, clone),
        ("`make demo`: installed", demo.marks_s[INSTALLED], demo),
        ("`make demo`: the table is printed", demo.marks_s[TABLE], demo),
        ("**from `git clone` to the first held-out table**", table_s, None),
        ("`pip install` of the wheels into an empty environment", pip.lasted_s, pip),
        ("the notebook's first plot", book.marks_s[PLOT], book),
        ("**from `pip install` to the first plot**", plot_s, None),
    ]
    rows = [
        [
            name,
            f"{seconds:.0f}",
            "" if step is None else f"{step.cpu_s:.0f}",
            "" if step is None else f"{step.load:.1f}",
        ]
        for name, seconds, step in ways
    ]
    return Report(
        name="service.new_user",
        title="A new user's first ten minutes",
        figures=figures,
        header=["step", "wall [s]", "CPU s of the whole command", "load at its end"],
        rows=rows,
        notes=[
            "Empty home, nothing cached: packages are fetched and installed, kernels compiled. `make demo` runs the "
            "shipped beam with the default settings, the notebook with its own small ones.",
            "Packages came from an index on the machine itself, so that fetching them costs less than elsewhere.",
        ],
        seed=seed,
    )


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    run_alone(measure)
