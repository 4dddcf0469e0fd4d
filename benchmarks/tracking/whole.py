"""The whole way of a rendered recording: pictures to a scene, a fit, its modulus and its held-out error, beside the
same fit of exact tracks.

The exact tracks are those of the same material points, seen in the same frames, under the gripper's exact way: what is
left of a difference is the camera's and the tracker's. Held-out errors of both are against the exact tracks. An effect
that a recording's truth has and nobody declares is sought by a trace of the imported scene.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tracking.measure import exact_tracks, scene_of
from physworld.arrays import Array
from physworld.calibrate import CalibrationConfig, FitResult, calibrate
from physworld.calibrate.discretisation import converged_parameters
from physworld.evaluate.metrics import track_error
from physworld.scene import Scene
from physworld.trace import TraceConfig, trace

EXACT_NOISE_M = 1e-4
"""Of exact tracks: what the lattice of a fit leaves of them."""
STIFFNESS = {
    "beam": "youngs_modulus_pa",
    "sheet": "youngs_modulus_pa",
    "rope": "bending_n_m2",
    "toy": "youngs_modulus_pa",
}


def whole_way(folder: Path, particles: int, exact_too: bool = True) -> dict[str, Any]:
    """Figures of a folder that ``render`` wrote.

    Args:
        folder: of the recording and its truth.
        particles: of the twins.
        exact_too: fit the exact tracks as well.
    """
    facts = json.loads((folder / "truth.json").read_text())
    scene, seconds = scene_of(folder)
    exact = exactly(folder, scene)
    config = CalibrationConfig(particle_budget=particles)
    found: dict[str, Any] = {
        "recording": folder.name,
        "points": int(scene.points.shape[1]),
        "seen_share": round(float(scene.visible.mean()), 3),
        "import_seconds": round(seconds, 1),
        "grip_rms_mm": round(
            1e3 * float(np.sqrt(((scene.controllers - exact.controllers) ** 2).sum(axis=2).mean())), 3
        ),
        "truth": facts["truth"],
    }
    name = STIFFNESS[facts["kind"]]
    for label, each in (("video", scene), ("exact", exact))[: 2 if exact_too else 1]:
        begun = time.process_time()
        fitted = calibrate(each, config)
        found[label] = _figures(each, fitted, exact, name, facts["truth"][name], particles)
        found[label]["processor_seconds"] = round(time.process_time() - begun, 1)
    if exact_too:
        ratio = found["video"]["held_out_mm"] / found["exact"]["held_out_mm"]
        found["held_out_over_exact"] = round(ratio, 2)
    return found


def named(folder: Path, particles: int) -> dict[str, Any]:
    """What a trace of a rendered recording answers, and what acted.

    Args:
        folder: of the recording and its truth.
        particles: of the twins.
    """
    facts = json.loads((folder / "truth.json").read_text())
    scene, _ = scene_of(folder)
    begun = time.process_time()
    answer = trace(
        scene,
        TraceConfig(
            calibration=replace(TraceConfig().calibration, particle_budget=particles), experiment=None
        ),
    )
    return {
        "recording": folder.name,
        "truth": facts["truth"],
        "verdict": answer.verdict.name,
        "named": {one.name: {k: n.value for k, n in one.parameters.items()} for one in answer.effects},
        "equivalent": [[one.name for one in members] for members in answer.equivalent],
        "reason": answer.verdict.reason,
        "misfit": [answer.declared.fitted.misfit, answer.verdict.model.fitted.misfit],
        "simulations": answer.simulations,
        "processor_seconds": round(time.process_time() - begun, 1),
    }


def exactly(folder: Path, scene: Scene) -> Scene:
    """The imported scene with the exact tracks of its points and the exact way of its gripper."""
    truth = np.load(folder / "truth.npz")
    centre = truth["grip_centre"]
    turned = np.einsum("tij,kj->tki", truth["grip_turns"], scene.controllers[0] - centre)
    return replace(
        scene,
        points=exact_tracks(folder, scene),
        controllers=turned + centre + truth["grip_shifts"][:, None],
        controller_errors_m=None,
        noise_covariance_m2=None,
        noise_sigma_m=EXACT_NOISE_M,
    )


def _figures(
    scene: Scene, fitted: FitResult, exact: Scene, name: str, truth: float, particles: int
) -> dict[str, Any]:
    frames = slice(*scene.test)
    own, error = fitted.parameters[name], _off(fitted.tracks, exact, frames)
    finer = converged_parameters(scene, fitted, particles)[name]
    ends = finer.ci95 or (np.nan, np.nan)
    return {
        name: own.value,
        "ci95": own.ci95,
        "without_lattice": finer.value,
        "without_lattice_ci95": finer.ci95,
        "off_percent": round(100.0 * (finer.value / truth - 1.0), 2),
        "covers": bool(ends[0] <= truth <= ends[1]),
        "searched": {p.name: fitted.parameters[p.name].value for p in fitted.searched},
        "rms_over_noise": fitted.losses["rms_over_noise"],
        "held_out_mm": round(1e3 * error, 3),
        "simulations": fitted.simulations,
    }


def _off(tracks: Array, exact: Scene, frames: slice) -> float:
    return track_error(tracks[frames], exact.points[frames], exact.visible[frames])


def table(figures: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| recording | points | grip [mm] | tracks | stiffness | true | off [%] | 95 % | covers | held out [mm] | "
        "over exact |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in figures:
        for label in ("video", "exact"):
            if label not in row:
                continue
            own = row[label]
            name = next(n for n in STIFFNESS.values() if n in own)
            ends = own["without_lattice_ci95"]
            told = "-" if ends is None else f"{ends[0]:.4g} to {ends[1]:.4g}"
            lines.append(
                f"| {row['recording']} | {row['points']} | {row['grip_rms_mm']:.2f} | {label} | "
                f"{own['without_lattice']:.4g} | {row['truth'][name]:.4g} | {own['off_percent']:+.1f} | {told} | "
                f"{'yes' if own['covers'] else 'no'} | {own['held_out_mm']:.2f} | "
                f"{row['held_out_over_exact'] if label == 'video' and 'held_out_over_exact' in row else ''} |"
            )
    return "\n".join(lines) + "\n"
