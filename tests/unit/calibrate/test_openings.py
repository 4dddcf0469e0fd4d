"""A fit of a recording in which a hand lets go: right when it is told so, far off when it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import recorded_by
from two_handed_bar import opened, two_handed_bar

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.scene import Scene
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

MODULUS_PA, SIGMA_M, FRAMES = 1.4e5, 3e-4, 61
FIT = CalibrationConfig(particle_budget=400, max_simulations=60)


@pytest.fixture(scope="module")
def recording() -> Scene:
    """Two seconds in which the second hand swings sideways and is open twice."""
    bar, times = two_handed_bar(), np.arange(FRAMES) / 30.0
    controllers = np.repeat(bar.controllers[:1], FRAMES, axis=0)
    controllers[:, 4:, 1] += 0.02 * np.sin(2 * np.pi * times)[:, None]
    scene = replace(
        bar,
        times=times,
        points=np.repeat(bar.points[:1], FRAMES, axis=0),
        visible=np.ones((FRAMES, bar.points.shape[1]), dtype=bool),
        controllers=controllers,
        grips=(bar.grips[0], opened(bar.grips[1], (0.4, 0.7), (1.5, 1.7))),
        train=(0, 42),
        test=(42, FRAMES),
        fps=30.0,
    )
    return recorded_by(build_twin(scene, 600).with_parameters(youngs_modulus_pa=MODULUS_PA), scene, SIGMA_M)


def test_the_stiffness_is_found_from_a_recording_in_which_a_hand_lets_go_twice(recording: Scene) -> None:
    found = calibrate(recording, FIT).twin
    assert found.parameters["youngs_modulus_pa"] == pytest.approx(MODULUS_PA, rel=0.03)
    tracks = found.track_nodes(found.simulate_nodes(*recording.control_track(), recording.times))
    held_out = np.linalg.norm(tracks - recording.points, axis=2)[slice(*recording.test)].mean()
    moved = np.linalg.norm(recording.points - recording.points[0], axis=2)[slice(*recording.test)].mean()
    assert held_out < 0.1 * moved


def test_pretending_that_the_hand_never_lets_go_finds_another_stiffness(recording: Scene) -> None:
    held = replace(recording, grips=tuple(replace(grip, open_s=()) for grip in recording.grips))
    assert calibrate(held, FIT).twin.parameters["youngs_modulus_pa"] < 0.5 * MODULUS_PA
