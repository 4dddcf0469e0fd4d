"""What a trace leaves behind on the service: the report and its files.

Files: ``report.json`` (:func:`physworld.trace.document`), ``tracks.npz`` (``times`` (T,) f8 [s], ``before`` and
``after`` (T, N, 3) f8 [m]: open loop from frame 0 without and with the effects, each calibrated on the training frames;
of several recordings those of the first, and ``before_k``, ``after_k`` of each), ``report.html`` (one self-contained
page), ``declared.npz``: the twin of the declared physics alone, calibrated anew (``Twin.to_arrays``), and, where the
trace found a better one than a fit's (``TraceResult.better``), ``twin.npz``.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from physworld.report import render
from physworld.trace import document
from physworld_storage.traces import DECLARED, PAGE, REPORT, TRACKS, TWIN
from physworld_workers.tasks.inputs import npz_bytes

if TYPE_CHECKING:
    from physworld.scene import Scene
    from physworld.trace import TraceResult

JSON, NPZ, HTML = "application/json", "application/x-npz", "text/html; charset=utf-8"


def trace_report(result: TraceResult) -> dict[str, Any]:
    """The machine-readable answer, the same as that of ``physworld trace``."""
    return document(result)


def trace_files(scene: Scene, result: TraceResult, report: dict[str, Any]) -> list[tuple[str, str, bytes]]:
    """Name, media type and content of every file, the report first."""
    tracks = {"times": scene.times, "before": result.before, "after": result.after}
    for k, known in enumerate(result.recordings if len(result.recordings) > 1 else ()):
        tracks |= {f"before_{k}": known.before, f"after_{k}": known.after}
    files = [
        (REPORT, JSON, json.dumps(report, indent=1, allow_nan=False).encode()),
        (TRACKS, NPZ, npz_bytes(tracks)),
        (PAGE, HTML, render(report, scene, result.before, result.after).encode()),
        (DECLARED, NPZ, npz_bytes(result.declared.fitted.twin.to_arrays())),
    ]
    if result.better is not None:
        files.append((TWIN, NPZ, npz_bytes(result.better.to_arrays())))
    return files
