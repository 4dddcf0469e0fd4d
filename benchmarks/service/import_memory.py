"""How much memory the import of a large recording takes: PhysTwin's pickle and a table of markers.

``python -m benchmarks.service.import_memory [--json FILE]``: writes two made recordings of 14.5 million coordinates,
imports each in a process of its own as the service's reader does (the whole file in memory, the scene, its archive into
a file), and prints the most memory that the process held.
"""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Report, run_alone

FRAMES, POINTS = 302, 16_000
TABLE_FRAMES, MARKERS = 4833, 1000
CHILD = "from benchmarks.service.import_memory import child; child()"


def measure(repeats: int, seed: int) -> Report:
    """Both recordings once: memory does not vary."""
    figures: dict[str, Any] = {}
    rows = []
    with tempfile.TemporaryDirectory(prefix="physworld-memory-") as name:
        folder = Path(name)
        for what, path in (
            ("PhysTwin's pickle", _pickle(folder, seed)),
            ("table of markers", _table(folder, seed)),
        ):
            done = subprocess.run(
                [sys.executable, "-c", CHILD, str(path)], capture_output=True, text=True, check=True
            )
            found = json.loads(done.stdout)
            figures[path.suffix[1:]] = found
            keys = ("file_mib", "imports_mib", "read_mib", "archived_mib")
            rows.append([what, *(f"{found[key]:.0f}" for key in keys), f"{found['seconds']:.1f}"])
            path.unlink()
    return Report(
        name="service.import_memory",
        title="Memory of a large import",
        figures=figures,
        header=[
            "recording",
            "file [MiB]",
            "process before [MiB]",
            "most until read [MiB]",
            "and archived [MiB]",
            "s",
        ],
        rows=rows,
        notes=[
            f"{FRAMES} frames of {POINTS} points with as many colours, and {TABLE_FRAMES} frames of {MARKERS} markers: "
            "14.5 million coordinates, doubles. The file itself is in memory all the while.",
        ],
        seed=seed,
    )


def child() -> None:
    """Import the file that the command line names; prints what it took."""
    from physworld_scenes.bundle import write_archive
    from physworld_scenes.importers import ImportOptions, import_any

    path = Path(sys.argv[1])
    before = _held_mib("VmRSS")
    started = time.perf_counter()
    data = path.read_bytes()
    said = (
        None
        if path.suffix == ".pkl"
        else ImportOptions(kind="blob", controllers=(), unit="m", up="z", assume=True)
    )
    scene, _ = import_any(data, path.name, said)
    read = _held_mib("VmHWM")
    with path.with_suffix(".zip").open("w+b") as stream:
        write_archive(scene, stream)
    found = {
        "file_mib": len(data) / 2**20,
        "imports_mib": before,
        "read_mib": read,
        "archived_mib": _held_mib("VmHWM"),
    }
    print(json.dumps({**found, "seconds": time.perf_counter() - started}))


def _held_mib(key: str) -> float:
    """Memory of this process now (VmRSS) or at most (VmHWM) [MiB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line for line in lines if line.startswith(key)).split()[1]) / 1024


def _pickle(folder: Path, seed: int) -> Path:
    """A cloud above the ground of PhysTwin's z-down world that drifts; a tenth of the samples is not seen."""
    rng = np.random.default_rng(seed)
    rest = np.clip(rng.normal(size=(POINTS, 3)) * 0.1, -0.3, 0.3) - np.array([0.0, 0.0, 1.0])
    drift = np.cumsum(rng.normal(size=(FRAMES, 1, 3)) * 1e-3, axis=0)
    points = rest + drift + rng.normal(size=(FRAMES, POINTS, 3)) * 1e-4
    content = {
        "object_points": points,
        "object_colors": rng.random((FRAMES, POINTS, 3)),
        "object_visibilities": rng.random((FRAMES, POINTS)) > 0.1,
        "object_motions_valid": np.ones((FRAMES, POINTS), dtype=bool),
        "controller_points": points[:, :30].copy(),
        "surface_points": rng.random((1000, 3)),
        "interior_points": rng.random((1000, 3)),
    }
    path = folder / "final_data.pkl"
    with path.open("wb") as stream:
        pickle.dump(content, stream, protocol=4)
    return path


def _table(folder: Path, seed: int) -> Path:
    """Markers that swing together, all of them seen."""
    rng = np.random.default_rng(seed)
    times = np.arange(TABLE_FRAMES) / 100.0
    rest = rng.uniform(-0.2, 0.2, (MARKERS, 3)) + np.array([0.0, 0.0, 1.0])
    swing = 0.05 * np.sin(3.0 * times)[:, None, None]
    path = folder / "take.npz"
    np.savez(path, points=rest + swing + rng.normal(size=(TABLE_FRAMES, MARKERS, 3)) * 2e-4, times=times)
    return path


if __name__ == "__main__":
    run_alone(measure)
