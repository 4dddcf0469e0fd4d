"""The hand-written limit beside our engines: an MLS-MPM in C++ for one machine, one thread and one law.

``mpm_limit.cpp`` is compiled for this processor with the system's compiler; without one the limit is not measured.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_name("mpm_limit.cpp")
_FLAGS = ("-O3", "-march=native", "-ffast-math", "-std=c++17", "-shared", "-fPIC")


def library() -> ctypes.CDLL | None:
    """The compiled step; None without a C++ compiler."""
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "mpm_limit.so"
        subprocess.run([compiler, *_FLAGS, str(SOURCE), "-o", str(target)], check=True)
        return ctypes.CDLL(str(target))


def mls_mpm(
    compiled: ctypes.CDLL,
    particles: np.ndarray,
    volumes: np.ndarray,
    strain_rate_per_s: float,
    grid: int,
    spacing_m: float,
    dt_s: float,
    material: tuple[float, float, float],
) -> Callable[[int, int], tuple[float, np.ndarray]]:
    """The engine: (substeps, records) to seconds a substep and the length along x at every record [m].

    Args:
        compiled: :func:`library`.
        particles: positions about the origin [m], (P, 3).
        volumes: [m^3], (P,).
        strain_rate_per_s: of the stretch along x that they start with.
        grid: nodes per axis.
        material: mu [Pa], lambda [Pa], density [kg/m^3].
    """
    count = len(particles)
    mu, lam, density = material
    volume = np.ascontiguousarray(volumes, dtype=np.float32)

    def run(substeps: int, records: int) -> tuple[float, np.ndarray]:
        x = (particles + 0.5 * grid * spacing_m).astype(np.float32)
        v = np.zeros((count, 3), np.float32)
        v[:, 0] = strain_rate_per_s * particles[:, 0]
        C = np.zeros((count, 3, 3), np.float32)
        C[:, 0, 0] = strain_rate_per_s
        F = np.repeat(np.eye(3, dtype=np.float32)[None], count, axis=0)
        arrays = [a.ctypes.data_as(ctypes.POINTER(ctypes.c_float)) for a in (x, v, C, F, volume)]
        numbers = [ctypes.c_float(value) for value in (spacing_m, dt_s, mu, lam, density)]
        lengths, seconds = [], 0.0
        for _ in range(records):
            start = time.perf_counter()
            compiled.run(count, grid, *numbers, substeps // records, *arrays)
            seconds += time.perf_counter() - start
            lengths.append(float(np.ptp(x[:, 0])))
        return seconds / (records * (substeps // records)), np.array(lengths)

    return run
