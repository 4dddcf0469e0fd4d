"""Several recordings of one object in one calibration: one material, each with its own start, grips and release."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene, recorded_by
from sagging_bar import BUDGET, SIGMA, TRUE_PA, sagging

from physworld.calibrate import CalibrationConfig, FitResult, Journal, calibrate, calibrate_in_stages
from physworld.calibrate.parameters import RELEASE_DELAY
from physworld.errors import Cancelled, SceneUnsupported
from physworld.scene import AS_MEASURED, UNDEFORMED_AT_REST, Grip, Scene
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

LOW, HIGH = np.array([0.0, -0.015, -0.015]), np.array([0.14, 0.015, 0.015])
MODULUS_PA, NOISE_M = 5e4, 3e-4
CONFIG = CalibrationConfig(particle_budget=60, max_simulations=90, damping="none")


def bar(frames: int, rate: float, modulus_pa: float = MODULUS_PA, name: str = "bar") -> Scene:
    """A bar in a clamp that is shaken at ``rate`` [1/s], as the engine moves it with this stiffness."""
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    points = [[x, y, 0.015] for x in np.linspace(0.05, 0.14, 4) for y in (-0.01, 0.01)]
    scene = made_scene(
        points, "beam", grip, frames, body=box_body(LOW, HIGH, density_kg_m3=300.0), name=name,
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.02, 0.015, 0.015])),), initial_state=UNDEFORMED_AT_REST,
    )  # fmt: skip
    shaken = 0.01 * np.sin(rate * scene.times)[:, None, None] * np.array([0.0, 0.5, 1.0])
    scene = replace(scene, controllers=scene.controllers + shaken)
    return recorded_by(build_twin(scene, 60).with_parameters(youngs_modulus_pa=modulus_pa), scene, NOISE_M)


def released(delay_frames: float) -> Scene:
    """A level bar that a hand lets go, whose motion shows ``delay_frames`` before it swings freely."""
    begun, still = sagging(frames=30), 5
    twin = replace(build_twin(begun, BUDGET), release_s=(still - 1 + delay_frames) / begun.fps)
    truth = twin.with_parameters(youngs_modulus_pa=TRUE_PA)
    points = truth.observe(truth.simulate_nodes(*begun.control_track(), begun.times), begun.times)
    points[still : still + round(delay_frames)] += [0.0, 0.0, 2e-3]
    noise = np.random.default_rng(2).normal(scale=0.2 * SIGMA, size=points.shape)
    return replace(begun, points=points + noise, initial_state=AS_MEASURED, noise_sigma_m=0.2 * SIGMA)


@pytest.fixture(scope="module")
def pair() -> list[Scene]:
    return [bar(24, 9.0), bar(32, 14.0, name="faster")]


@pytest.fixture(scope="module")
def found(pair: list[Scene]) -> FitResult:
    return calibrate(pair, CONFIG)


def test_two_recordings_find_their_material_closer_than_the_one(pair: list[Scene], found: FitResult) -> None:
    def interval(fit: FitResult) -> tuple[float, float]:
        ends = fit.parameters["youngs_modulus_pa"].ci95
        assert ends is not None
        return ends

    low, high = interval(found)
    assert low < MODULUS_PA < high
    alone = interval(calibrate(pair[0], CONFIG))
    assert high - low < alone[1] - alone[0]
    (agreement,) = found.agreement
    assert agreement.name == "youngs_modulus_pa" and agreement.agrees
    assert [known.scene.name for known in found.recordings] == ["bar", "faster"]
    for known, scene in zip(found.recordings, pair, strict=True):
        assert known.twin.law == found.twin.law
        assert known.tracks.shape == scene.points.shape
        assert known.losses["rms_over_noise"] < 1.1


def test_a_list_of_one_is_the_one(pair: list[Scene]) -> None:
    few = replace(CONFIG, max_simulations=20)
    one, listed = calibrate(pair[0], few), calibrate(pair[:1], few)
    assert np.array_equal(one.tracks, listed.tracks) and one.parameters == listed.parameters
    assert listed.recordings == () and listed.agreement == ()


def test_recordings_of_two_stiffnesses_say_by_how_much_they_disagree() -> None:
    fit = calibrate([bar(24, 9.0), bar(24, 14.0, 1.5 * MODULUS_PA, "stiffer")], CONFIG)
    (agreement,) = fit.agreement
    assert not agreement.agrees
    soft, stiff = agreement.own
    assert soft is not None and stiff is not None
    assert soft < agreement.value < stiff
    assert soft == pytest.approx(MODULUS_PA, rel=0.15) and stiff == pytest.approx(1.5 * MODULUS_PA, rel=0.15)
    low, high = agreement.shifts
    assert low is not None and high is not None and min(low, -high) < -3.0


def test_every_recording_has_a_release_of_its_own() -> None:
    scenes = [released(2.5), released(1.0)]
    fit = calibrate(scenes, replace(CONFIG, particle_budget=BUDGET, max_simulations=260))
    assert fit.parameters["youngs_modulus_pa"].value == pytest.approx(TRUE_PA, rel=0.02)
    for k, (name, frames) in enumerate(((RELEASE_DELAY, 2.5), (f"recording_2.{RELEASE_DELAY}", 1.0))):
        fps = scenes[k].fps
        assert fit.parameters[name].value == pytest.approx(frames / fps, abs=0.3 / fps), name
        assert fit.recordings[k].twin.release_delay_s == pytest.approx(fit.parameters[name].value)
    assert [known.name for known in fit.agreement] == ["youngs_modulus_pa"]


def test_a_search_over_two_goes_on_from_its_journal(pair: list[Scene], found: FitResult) -> None:
    kept: list[str] = []
    with pytest.raises(Cancelled):
        calibrate(pair, CONFIG, cancelled=lambda: len(kept) >= 3, journal=Journal("k", None, kept.append))
    again = calibrate(pair, CONFIG, journal=Journal("k", kept[-1]))
    assert again.parameters == found.parameters and again.simulations == found.simulations


def test_a_budget_that_ends_leaves_no_word_on_agreement(pair: list[Scene]) -> None:
    fit = calibrate(pair, replace(CONFIG, max_simulations=12))
    assert fit.cut_short and fit.agreement == () and len(fit.recordings) == 2


@pytest.mark.parametrize(
    ("several", "message"),
    [
        (list, "needs a recording"),
        (lambda: [bar(14, 9.0), made_scene([[0.1 * k, 0, 0] for k in range(4)], "rope")], "one form of body"),
    ],
)
def test_what_is_no_one_object_is_refused(several: Callable[[], list[Scene]], message: str) -> None:
    with pytest.raises(SceneUnsupported, match=message):
        calibrate(several(), CONFIG)


def test_a_field_is_of_one_recording(pair: list[Scene]) -> None:
    with pytest.raises(SceneUnsupported, match="to one recording; these are 2"):
        calibrate_in_stages(pair, CONFIG, "global+local")
