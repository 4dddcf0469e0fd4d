"""Gauss-Newton over three global parameters: simulations it takes and errors it leaves where the truth is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.harness import Report
from benchmarks.verification.calibration_known import recorded_by
from physworld.calibrate import CalibrationConfig
from physworld.calibrate.global_stage import prior_twin, searched_parameters
from physworld.calibrate.search import Search
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.twin.build import build_twin

LENGTH_M, RADIUS_M, FRAMES = 0.4, 0.004, 55
TRUTH = {"bending_n_m2": 5e-3, "air_drag_per_s": 1.5, "relaxation_s": 0.007}
SIGMA_M, FINER = 1e-4, 1.5
FIRST_M, CLAMP_M = (
    0.04,
    0.0225,
)  # the rope's first point, and how much of it is clamped: whole cells on both lattices
OFF = 2.0  # every start is this many times too low
STAGES = ((0.0, 3), (1.0, 5))  # share of the frames between the first window and all, iterations
MOST = 40


def descent(seed: int, shared: Path) -> Report:
    """Bending stiffness, air drag and internal friction of a shaken rope, recorded by our engine."""
    del shared
    config = CalibrationConfig()
    figures, rows, cells_mm = {}, [], []
    for refinement, declared in ((1.0, True), (FINER, True), (1.0, False), (FINER, False)):
        still = shaken_rope(declared)
        truth = build_twin(still, refinement=refinement).with_parameters(**TRUTH)
        cells_mm.append(1e3 * float(truth.lattice.spacing[0]))
        scene = recorded_by(truth, still, SIGMA_M, seed)
        search = Search(scene, prior_twin(scene, config), MOST, None, None)
        known = {p.name: p for p in searched_parameters(scene, search.twin, config)}
        parameters = [known[name] for name in TRUTH]
        theta = np.array([p.searched(TRUTH[p.name] / OFF) for p in parameters])
        window = search.first_window()
        for share, iterations in STAGES:
            end = window + round(share * (search.end - window))
            theta = search.solve(parameters, theta, iterations, end).theta
        errors = {
            p.name: p.value(float(t)) / TRUTH[p.name] - 1 for p, t in zip(parameters, theta, strict=True)
        }
        name = "the same cells" if refinement == 1.0 else f"cells {refinement:g} times smaller"
        name += "" if declared else ", clamp not declared"
        figures[name] = {"simulations": search.simulations, "errors": errors}
        rows.append([name, str(search.simulations), *(f"{error:+.2%}" for error in errors.values())])
    return Report(
        name="calibration",
        title="Gauss-Newton over three parameters",
        figures=figures,
        header=["recorded on", "simulations", *TRUTH],
        rows=rows,
        notes=[
            f"A rope of {LENGTH_M:g} m that a hand shakes and then holds still, {SIGMA_M * 1e3:g} mm of noise. Every "
            f"number starts {OFF:g} times too low and is searched over a first window of frames, then over all "
            "training frames; the errors of what is found.",
            f"The clamp is {CLAMP_M * 1e3:g} mm of the rope, whole cells of both. Where a scene does not declare it, a "
            f"rope is held by the one cell nearest to the hand, {cells_mm[0]:.4g} mm long in the fit and "
            f"{cells_mm[1]:.4g} mm in the finer recording: the free lengths differ by {_shorter(*cells_mm[:2]):.1%}, "
            "and the stiffness of bending takes up the fourth to fifth power of that.",
        ],
        seed=seed,
    )


def _shorter(long_mm: float, short_mm: float) -> float:
    """How much less of the rope is free beyond a longer cell, of what is free beyond a shorter one."""
    length_mm = 1e3 * (LENGTH_M - FIRST_M)
    return (long_mm - short_mm) / (length_mm - short_mm)


def shaken_rope(declared: bool = True) -> Scene:
    """A stiff rope that a hand of four points holds at one end, shakes to and fro and then keeps still.

    ``declared``: whether the scene says how much of the rope is held.
    """
    hand = 0.02 * np.array([[0, 1.0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    times = np.arange(FRAMES) / 30.0
    shake = 0.03 * np.sin(2 * np.pi * 1.5 * times) ** 2 * (times < 1 / 1.5)
    held = np.array([[0.0, -RADIUS_M, -RADIUS_M], [FIRST_M + CLAMP_M, RADIUS_M, RADIUS_M]])
    points = np.linspace([FIRST_M, 0.0, 0.0], [LENGTH_M, 0.0, 0.0], 10)
    return Scene(
        name="rope",
        kind="rope",
        points=np.repeat(points[None], FRAMES, axis=0),
        visible=np.ones((FRAMES, len(points)), dtype=bool),
        controllers=hand[None] + shake[:, None, None] * np.array([0.0, 1.0, 0.5]),
        times=times,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=SIGMA_M,
        train=(0, 40),
        test=(40, FRAMES),
        initial_state=UNDEFORMED_AT_REST,
        body=Body(length_m=LENGTH_M, radius_m=RADIUS_M),
        grips=(Grip((0, 1, 2, 3), *held),) if declared else (),
    )
