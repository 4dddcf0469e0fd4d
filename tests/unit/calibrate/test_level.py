"""A frame that is out of level: where gravity points is found on measured recordings, and belongs to each of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sagging_bar import BUDGET, SIGMA, TRUE_PA, sagging

from physworld.calibrate import CalibrationConfig, calibrate, carried_over
from physworld.calibrate.parameters import TILTS, level
from physworld.effects.gravity_tilt import GravityTilt
from physworld.scene import AS_MEASURED, UNDEFORMED_AT_REST, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

TILT_RAD, FRAMES = 0.05, 24
ROLLED = "gravity_tilt_x_rad"  # about the bar: it sags sideways


def truth(scene: Scene, tilt_rad: float) -> Twin:
    twin = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=TRUE_PA)
    return twin.with_effect(GravityTilt(tilt_x_rad=tilt_rad)) if tilt_rad else twin


def measured(tilt_rad: float, seed: int = 1) -> Scene:
    begun = sagging(frames=FRAMES)
    twin = truth(begun, tilt_rad)
    points = twin.observe(twin.simulate_nodes(*begun.control_track(), begun.times), begun.times)
    noise = np.random.default_rng(seed).normal(scale=SIGMA, size=points.shape)
    return replace(begun, points=points + noise, initial_state=AS_MEASURED, noise_sigma_m=SIGMA)


def of(twin: Twin) -> GravityTilt | None:
    return next((known for known in twin.effects if isinstance(known, GravityTilt)), None)


@pytest.mark.slow
def test_a_frame_out_of_level_is_found_beside_the_stiffness() -> None:
    config = CalibrationConfig(particle_budget=BUDGET, max_simulations=120)
    found = calibrate(measured(TILT_RAD), config)
    assert found.parameters[ROLLED].value == pytest.approx(TILT_RAD, abs=0.005)
    low, high = found.parameters[ROLLED].ci95 or (np.nan, np.nan)
    assert low < TILT_RAD < high
    assert found.parameters["youngs_modulus_pa"].value == pytest.approx(TRUE_PA, rel=0.02)
    upright = calibrate(measured(0.0), config)
    assert not set(TILTS) & {p.name for p in upright.searched} and of(upright.twin) is None
    declared = calibrate(measured(TILT_RAD), replace(config, damping="none"))
    assert not set(TILTS) & {p.name for p in declared.searched}


def test_another_recording_has_its_own_level() -> None:
    carried = carried_over(truth(measured(0.0), -TILT_RAD), measured(TILT_RAD), BUDGET)
    assert carried.law == truth(measured(0.0), 0.0).law
    tilt = of(carried)
    assert tilt is not None and tilt.tilt_x_rad == pytest.approx(TILT_RAD, abs=0.005)
    assert of(carried_over(truth(measured(0.0), TILT_RAD), measured(0.0), BUDGET)) is None


def test_only_measured_frames_with_gravity_are_asked() -> None:
    scene = measured(0.0)
    twin = build_twin(scene, BUDGET)
    assert [p.name for p in level(scene, twin)] == list(TILTS)
    assert level(replace(scene, initial_state=UNDEFORMED_AT_REST), twin) == []
    assert level(scene, replace(twin, gravity_m_s2=np.zeros(3))) == []
