"""Several recordings of one rope or cloth: numbers with priors, and of each recording its own rest shape or camera."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from made_scene import recorded_by
from test_carry import POINTS, swung
from test_cloths import LATE_S, TURN_RAD
from test_cloths import recorded as cloth
from test_rods import BENDING, CURVATURE, truth
from test_rods import recorded as rope

from physworld.calibrate import CalibrationConfig, FitResult, Journal, calibrate
from physworld.calibrate.rod_recordings import require_alike
from physworld.engine.rods.chain import Chain
from physworld.errors import Cancelled, SceneUnsupported
from physworld.scene import Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

CONFIG = CalibrationConfig(max_simulations=150)


@cache
def pair() -> list[Scene]:
    """A rope that is curved one way in the first recording, and the other way in the second."""
    first = rope()
    twin = truth(first)
    assert twin.natural is not None
    second = recorded_by(replace(twin, natural=-twin.natural), first, 2e-4, seed=1)
    return [first, replace(second, name="turned")]


@pytest.fixture(scope="module")
def found() -> FitResult:
    return calibrate(pair(), CONFIG)


def test_a_rope_has_one_stiffness_and_a_rest_shape_in_every_recording(found: FitResult) -> None:
    low, high = found.parameters["bending_n_m2"].ci95 or (0.0, 0.0)
    assert low < BENDING < high
    first, second = found.recordings
    assert first.twin.law == second.twin.law
    for name, value in (("curvature_0_0", CURVATURE), ("recording_2.curvature_0_0", -CURVATURE)):
        assert found.parameters[name].value == pytest.approx(value, abs=0.3), name
    for known in found.recordings:
        assert known.losses["rms_m"] < 2e-3  # of ropes that swing by 12 cm
    agreement = {known.name: known for known in found.agreement}
    assert agreement["bending_n_m2"].agrees
    assert not any("curvature" in name for name in agreement)


def test_a_rope_goes_on_from_its_journal(found: FitResult) -> None:
    kept: list[str] = []
    with pytest.raises(Cancelled):
        calibrate(pair(), CONFIG, cancelled=lambda: len(kept) >= 2, journal=Journal(save=kept.append))
    again = calibrate(pair(), CONFIG, journal=Journal(stored=kept[-1]))
    assert again.parameters == found.parameters and again.simulations == found.simulations


def test_a_budget_is_of_all_recordings() -> None:
    fit = calibrate(pair(), replace(CONFIG, max_simulations=8))
    assert fit.cut_short and fit.agreement == ()
    assert fit.simulations <= 8 + 2 * 11  # what measures the state beside the search


def test_branched_rods_with_other_points_are_no_one_object() -> None:
    def branched(points: int) -> Twin:
        twin = build_twin(swung(1.1, points))
        assert isinstance(twin.lattice, Chain)
        parent = twin.lattice.parent.copy()
        parent[-1] = 2
        return replace(twin, body=replace(twin.body, lattice=replace(twin.lattice, parent=parent)))

    with pytest.raises(SceneUnsupported, match="same points along it"):
        require_alike([branched(POINTS), branched(POINTS + 8)])


def test_every_recording_of_a_cloth_has_its_own_camera() -> None:
    scene = cloth()
    turned = scene.points.copy()
    turned -= turned[0]
    about_z = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    other = replace(
        scene, points=scene.points[0] + turned + 2.0 * TURN_RAD * turned @ about_z.T, name="turned"
    )
    fit = calibrate([scene, other], CalibrationConfig(particle_budget=500, max_simulations=80))
    own, others = (
        fit.parameters[name].value
        for name in ("measurement_turn.z_rad", "recording_2.measurement_turn.z_rad")
    )
    assert own == pytest.approx(TURN_RAD, abs=0.01)
    assert others == pytest.approx(-TURN_RAD, abs=0.01)  # the one camera's turn, less twice as much
    assert fit.parameters["actuation_lag.lag_s"].value == pytest.approx(LATE_S, abs=0.015)
    assert {known.name for known in fit.agreement} >= {"bending_n_m", "air_on_sheet.quadratic_kg_m3"}
    assert all(known.agrees for known in fit.agreement)
