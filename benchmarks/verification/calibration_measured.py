"""Calibration of recordings of other engines in which no effect is hidden; real objects: :mod:`benchmarks.measured`."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Report
from benchmarks.verification.calibration_known import MODULUS, kilo, searched_words, with_interval
from physworld.calibrate import CalibrationConfig, FitResult, Journal, calibrate
from physworld.calibrate.discretisation import converged_parameters
from physworld.engine.thin.triangles import Mesh
from physworld.evaluate.table import held_out_table
from physworld.scene import Scene
from physworld_scenes.bundle import canonical_archive, read_bundle

CLEAN = {"d02": None, "d07": Mesh((16, 15))}  # and the mesh of triangles that recorded a sheet


def _add(
    name: str,
    scene: Scene,
    truth: dict[str, Any],
    config: CalibrationConfig,
    fitted: FitResult,
    figures: dict[str, Any],
    rows: list[list[str]],
) -> None:
    """The figures and the row of a fit whose truth is known."""
    estimate = fitted.parameters[MODULUS]
    # stiffness over density shows: the truth at the declared density
    true_pa = truth["young"] * scene.body.density_kg_m3 / truth["density"]
    converged = None
    if fitted.twin.lattice.smooth:
        converged = converged_parameters(scene, fitted, config.particle_budget)[MODULUS]
    ratio = {
        part: rms(fitted.tracks, scene, frames) / scene.noise_sigma_m
        for part, frames in (("train", scene.train), ("test", scene.test))
    }
    table = held_out_table(scene, {"twin": fitted.tracks})
    figures[name] = {
        "rms_over_noise": ratio,
        "track_m": table["track_m"],
        "chamfer_phystwin_m": table["chamfer_phystwin_m"],
        "chamfer_l2_m": table["chamfer_l2_m"],
        "noise_floor_m": table["noise_floor_m"],
        "found_pa": estimate.value,
        "ci95_pa": estimate.ci95,
        "converged_pa": None if converged is None else converged.value,
        "true_pa": true_pa,
        "simulations": fitted.simulations,
        "seconds": fitted.seconds,
    }
    rows.append(
        [f"{name} ({scene.kind})", f"{ratio['train']:.2f}", f"{ratio['test']:.2f}", kilo(true_pa),
         with_interval(estimate), "-" if converged is None else with_interval(converged), searched_words(fitted)]
    )  # fmt: skip


def undeclared(seed: int, shared: Path, resume: Path | None = None) -> Report:
    """Scenes of independent engines in which nothing is hidden."""
    figures, rows = {}, []
    for name, mesh in CLEAN.items():
        scene = read_bundle(shared / "undeclared" / name)
        truth = json.loads((shared / "undeclared" / name / "truth.json").read_text())
        config = CalibrationConfig()
        fitted = fit(scene, config, resume)
        _add(name, scene, truth, config, fitted, figures, rows)
        if mesh is not None:
            meshed = replace(config, mesh=mesh)
            _add(f"{name} as {mesh}", scene, truth, meshed, fit(scene, meshed, resume), figures, rows)
    return Report(
        name="calibration",
        title="Scenes of other engines without a hidden effect",
        figures=figures,
        header=[
            "scene",
            "train rms / σ",
            "test rms / σ",
            "true E, kPa",
            "found",
            "without lattice error",
            "searched",
        ],
        rows=rows,
        notes=[
            "rms is over all coordinates: 1 is the floor (the distance's is σ √3). The true modulus is scaled to the "
            "declared density, since only their ratio shows.",
            "As a mesh: of the triangles that recorded it, named by `--mesh` (docs/adr/0021-sheets-of-triangles.md).",
        ],
        seed=seed,
    )


def fit(scene: Scene, config: CalibrationConfig, resume: Path | None) -> FitResult:
    """The calibration, its finished steps read from and kept in ``resume``."""
    if resume is None:
        return calibrate(scene, config)
    resume.mkdir(parents=True, exist_ok=True)
    path = resume / f"{scene.name}.json"
    stored = path.read_text() if path.exists() else None
    key = f"{hashlib.sha256(canonical_archive(scene)).hexdigest()} {config}"
    return calibrate(scene, config, journal=Journal(key, stored, path.write_text))


def rms(tracks: np.ndarray, scene: Scene, frames: tuple[int, int]) -> float:
    """Root mean squared coordinate error over visible points [m]; frame 0 is not scored."""
    window = slice(max(frames[0], 1), frames[1])
    error = (tracks[window] - scene.points[window])[scene.visible[window]]
    return float(np.sqrt(np.mean(error**2)))
