"""Gauss-Newton over three global parameters: simulations it takes and errors it leaves where the truth is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.calibration_known import recorded_by
from benchmarks.harness import Report
from physworld.build import build_twin
from physworld.calibrate import CalibrationConfig
from physworld.calibrate.global_stage import prior_twin, searched_parameters
from physworld.calibrate.search import Search
from physworld.scene import UNDEFORMED_AT_REST, Body, Scene

LENGTH_M, RADIUS_M, FRAMES = 0.4, 0.004, 55
TRUTH = {"bending_n_m2": 5e-3, "air_drag_per_s": 1.5, "relaxation_s": 0.007}
SIGMA_M, REFINEMENTS = 1e-4, (1.0, 1.5)
OFF = 2.0  # every start is this many times too low
STAGES = ((0.0, 3), (1.0, 5))  # share of the frames between the first window and all, iterations
MOST = 40


def descent(seed: int, shared: Path) -> Report:
    """Bending stiffness, air drag and internal friction of a shaken rope, recorded by our engine."""
    del shared
    still, config = shaken_rope(), CalibrationConfig()
    figures, rows = {}, []
    for refinement in REFINEMENTS:
        truth = build_twin(still, refinement=refinement).with_parameters(**TRUTH)
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
            "A rope's clamp seems to reach a share of a cell further on larger cells, and the stiffness of bending "
            "takes up the fourth power of the free length.",
        ],
        seed=seed,
    )


def shaken_rope() -> Scene:
    """A stiff rope that a hand of four points holds at one end, shakes to and fro and then keeps still."""
    hand = 0.02 * np.array([[0, 1.0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    times = np.arange(FRAMES) / 30.0
    shake = 0.03 * np.sin(2 * np.pi * 1.5 * times) ** 2 * (times < 1 / 1.5)
    points = np.linspace([0.04, 0.0, 0.0], [LENGTH_M, 0.0, 0.0], 10)
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
    )
