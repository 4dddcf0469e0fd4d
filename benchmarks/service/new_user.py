"""A new user's times, from an empty folder: to the first held-out table, and to the first plot in a notebook.

``python -m benchmarks.service.new_user [--json FILE]`` measures what is committed. Both begin with an empty home, so
that no package and no kernel is cached, and with those variables alone that say where things come from (``KEPT``).

1. `git clone`, `make demo` (which installs) until the results table is printed.
2. An empty environment, `pip install` of the wheels that were built in the clone, with what a notebook needs, and the
   guide's first notebook (docs/notebooks/recording_to_model.ipynb), which starts the service, fits, demonstrates and
   trains, until its first plot. Building the wheels is not the user's work and is not counted.

An emptied environment stands in for a bare machine: this system's Python, git and make are used, and its files are
cached in memory. Packages come from the index that pip is set up with; how near that is decides much of both.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
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
KEPT = (
    "LANG",
    "LC_",
    "TERM",
    "PIP_",
    "SSL_",
    "CURL_CA",
    "REQUESTS_CA",
    "GIT_SSL",
    "HTTP_PROXY",
    "HTTPS_PROXY",
)
PATH = "/usr/local/bin:/usr/bin:/bin"
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
    steps: dict[str, Followed] = {}
    with tempfile.TemporaryDirectory(prefix="physworld-new-user-") as folder:
        base = Path(folder)
        clone, environment = base / "physworld", fresh(base / "home")
        steps["clone"] = follow(["git", "clone", "--quiet", ROOT.as_uri(), clone.name], base, environment)
        steps["demo"] = follow(["make", "demo"], clone, environment, (INSTALLED, TABLE))
        follow(["make", "--silent", "wheels"], clone, environment)
        notebook = base / "notebook"
        notebook.mkdir()
        steps |= _notebook(clone, notebook, fresh(notebook / "home"))
    return _report(steps, seed)


def fresh(home: Path) -> dict[str, str]:
    """The variables of somebody who has just logged in, with an empty home."""
    home.mkdir(exist_ok=True)
    kept = {name: value for name, value in os.environ.items() if name.upper().startswith(KEPT)}
    return {**kept, "PATH": PATH, "HOME": str(home)}


def _notebook(clone: Path, base: Path, environment: Mapping[str, str]) -> dict[str, Followed]:
    """An empty environment, the clone's wheels, and the guide's notebook beside the sample scene."""
    for part in (NOTEBOOK, Path("sample/soft_beam")):
        (base / part).parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (clone / part).is_dir() else shutil.copy)(clone / part, base / part)
    wheels = [
        f"{wheel}{extras}"
        for name, extras in EXTRAS.items()
        for wheel in (clone / "dist").glob(f"{name}*.whl")
    ]
    python = str(base / "venv" / "bin" / "python")
    made = follow(["python3", "-m", "venv", "venv"], base, environment)
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
            "An emptied environment (new home, new virtual environment, few variables) stands in for a bare machine; "
            "packages came from the index that pip is set up with here.",
        ],
        seed=seed,
    )


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    run_alone(measure)
