"""Resume of a calibration: what an earlier attempt finished is not simulated again, and the end is the same."""

from __future__ import annotations

import json

import numpy as np
import pytest
from made_scene import box_body, made_scene, recorded_by

from physworld.calibrate import CalibrationConfig, Journal, calibrate
from physworld.errors import Cancelled
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

CONFIG = CalibrationConfig(particle_budget=60, max_simulations=60)
LOW, HIGH = np.array([0.0, -0.015, -0.015]), np.array([0.12, 0.015, 0.015])


@pytest.fixture(scope="module")
def bar() -> Scene:
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    scene = made_scene(
        [[x, 0.0, 0.015] for x in np.linspace(0.03, 0.12, 5)],
        "beam",
        grip,
        14,
        body=box_body(LOW, HIGH, density_kg_m3=300.0),
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.02, 0.015, 0.015])),),
        initial_state=UNDEFORMED_AT_REST,
    )
    return recorded_by(build_twin(scene, 60).with_parameters(youngs_modulus_pa=4e4), scene, 2e-4)


def test_a_killed_calibration_ends_where_the_uninterrupted_one_does(bar: Scene) -> None:
    whole: list[str] = []
    uninterrupted = calibrate(bar, CONFIG, journal=Journal("bar", None, whole.append))
    kept: list[str] = []

    def killed() -> bool:
        return len(kept) >= 4

    with pytest.raises(Cancelled):
        calibrate(bar, CONFIG, cancelled=killed, journal=Journal("bar", None, kept.append))
    assert whole[3] == kept[-1]  # the same way so far
    runs: list[int] = []
    again = Journal("bar", kept[-1])
    resumed = calibrate(bar, CONFIG, progress=lambda done, most, text: runs.append(done), journal=again)
    done_before = json.loads(kept[-1])["entries"][-1]["found"]["simulations"]
    assert runs[0] == done_before + 1  # nothing again
    assert resumed.parameters == uninterrupted.parameters
    assert resumed.simulations == uninterrupted.simulations
    assert resumed.loss_history == uninterrupted.loss_history
    np.testing.assert_array_equal(resumed.tracks, uninterrupted.tracks)


def test_the_journal_of_something_else_or_a_torn_one_is_ignored() -> None:
    stored: list[str] = []
    Journal("a", None, stored.append).step("scan", lambda: {"cost": float("nan")})
    assert json.loads(stored[0])["entries"] == [{"name": "scan", "found": {"cost": None}}]
    torn = [Journal("a", text) for text in (stored[0][:-5], "[]", "null", "3")]
    for journal in (Journal("b", stored[0]), *torn):
        assert journal.step("scan", lambda: {"cost": 2.0}) == {"cost": 2.0}
    assert Journal("a", stored[0]).step("scan", lambda: {"cost": 2.0}) == {"cost": None}


def test_a_step_of_another_name_drops_what_follows() -> None:
    stored: list[str] = []
    first = Journal("a", None, stored.append)
    for name in ("scan", "solve", "shift"):
        first.step(name, lambda: {"by": 1})
    again = Journal("a", stored[-1], stored.append)
    assert again.step("scan", lambda: {"by": 2}) == {"by": 1}
    assert again.step("screen", lambda: {"by": 2}) == {"by": 2}
    assert [entry["name"] for entry in json.loads(stored[-1])["entries"]] == ["scan", "screen"]
