"""Calibration of sheets that another engine recorded on meshes of growing fineness: what its mesh does to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.harness import Report
from benchmarks.peers.flex_sheet import FPS, FlexSheet, bending_stiffnesses, record
from benchmarks.verification.calibration_known import MODULUS, kilo, searched_words, with_interval
from physworld.calibrate import CalibrationConfig, calibrate
from physworld.scene import Scene

SUBDIVISIONS = (1, 2)
_SHOWN_S = (0.3, 1.0, 2.0)  # after which the meshes are compared


def sheets(seed: int, shared: Path) -> Report:
    """The same sheet and motion on MuJoCo's meshes; the modulus that a calibration without damping finds."""
    del shared
    scenes = {k: record(FlexSheet(subdivision=k, seed=seed)) for k in SUBDIVISIONS}
    truth, figures, rows = FlexSheet(seed=seed), {}, []
    for k, scene in scenes.items():
        hinges = bending_stiffnesses(FlexSheet(subdivision=k))
        fitted = calibrate(scene, CalibrationConfig(damping="none"))
        estimate = fitted.parameters[MODULUS]
        ratio = {part: _rms(fitted.tracks, scene, frames) / truth.noise_sigma_m
                 for part, frames in (("train", scene.train), ("test", scene.test))}  # fmt: skip
        figures[f"{k}"] = {
            "hinges": hinges,
            "found_pa": estimate.value,
            "ci95_pa": estimate.ci95,
            "rms_over_noise": ratio,
            "simulations": fitted.simulations,
            "seconds": fitted.seconds,
        }
        counts = FlexSheet(subdivision=k).counts
        rows.append(
            [f"{counts[0]} x {counts[1]}", " / ".join(f"{hinges[name]:.2f}" for name in ("warp", "weft", "twist")),
             f"{ratio['train']:.2f}", f"{ratio['test']:.2f}", kilo(truth.young_pa), with_interval(estimate),
             searched_words(fitted)]
        )  # fmt: skip
    first, second = (scenes[k] for k in SUBDIVISIONS)
    # the same draws of the noise: it goes out of the difference
    apart = {
        s: float(np.sqrt(np.mean((first.points - second.points)[round(FPS * s)] ** 2))) for s in _SHOWN_S
    }
    return Report(
        name="calibration",
        title="Sheets of MuJoCo flex with known truth",
        figures={"meshes": figures, "apart_m": apart},
        header=["cells", "warp / weft / twist over a plate", "train rms / σ", "test rms / σ", "true E, kPa", "found",
                "searched"],
        rows=rows,
        notes=[
            "24 x 26 cm, held by two moving corners, 300 points, 1 mm of noise; no damping in the engine or the fit.",
            "The two meshes themselves part by "
            + ", ".join(f"{1e3 * gap:.1f} mm after {s:g} s" for s, gap in apart.items())
            + " (root mean square per axis).",
        ],
        seed=seed,
    )  # fmt: skip


def _rms(tracks: np.ndarray, scene: Scene, frames: tuple[int, int]) -> float:
    part = slice(*frames)
    return float(np.sqrt(np.mean((tracks[part] - scene.points[part])[scene.visible[part]] ** 2)))
