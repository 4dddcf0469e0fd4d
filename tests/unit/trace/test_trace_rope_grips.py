"""Grips of ropes: what a rod's shear does next to a hand is calibrated, so it is no grip that gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene
from sagging_bar import sagging

from physworld.calibrate import CalibrationConfig
from physworld.effects.registry import effect
from physworld.scene import UNDEFORMED_AT_REST, Body, Scene
from physworld.trace import TraceConfig, TraceResult, trace
from physworld.trace.unknowns import hold_unknowns
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

LENGTH, RADIUS, DENSITY, SIGMA, FRAMES = 0.4, 0.0075, 900.0, 2e-4, 40
YOUNG_PA, POISSON, SHEAR_SHARE = 1e6, 0.4, 0.9
CONFIG = TraceConfig(
    calibration=CalibrationConfig(particle_budget=60, damping="none"), bootstraps=50, experiment=None,
    candidates=("grip_slip", "gravity_tilt", "air_drag_linear"),
)  # fmt: skip


def rope() -> Scene:
    """It hangs askew and is swung."""
    points = np.linspace(0.03, LENGTH, 12)[:, None] * [0.5, 0.0, -np.sqrt(0.75)]
    scene = made_scene(
        points, "rope", np.zeros((1, 3)), FRAMES, initial_state=UNDEFORMED_AT_REST, noise_sigma_m=SIGMA,
        body=Body(length_m=LENGTH, radius_m=RADIUS, density_kg_m3=DENSITY),
    )  # fmt: skip
    swing = 0.02 * np.sin(6.0 * scene.times)[:, None, None] ** 2 * np.array([1.0, 0.7, 0.2])
    return replace(scene, controllers=scene.controllers + swing)


def twin_of(scene: Scene) -> Twin:
    return build_twin(scene, 60).with_parameters(bending_n_m2=YOUNG_PA * np.pi * RADIUS**4 / 4)


def sheared() -> float:
    """What a sideways force at the hand displaces the rope by, over the force [m/N]: Timoshenko, k G A."""
    area, tension = np.pi * RADIUS**2, DENSITY * np.pi * RADIUS**2 * LENGTH * 9.81
    bends_along = np.sqrt(YOUNG_PA * np.pi * RADIUS**4 / 4 / tension)
    return float(bends_along / (SHEAR_SHARE * YOUNG_PA / (2 * (1 + POISSON)) * area))


def test_the_compliance_that_is_calibrated_goes_up_to_what_the_shear_of_a_round_rope_does() -> None:
    known = {u.name: u for u in hold_unknowns(twin_of(rope()))}["grip_slip.compliance_m_n"]
    assert known.prior is not None and known.low == 0.0
    assert known.value(known.prior[1]) == pytest.approx(sheared(), rel=0.15)
    assert known.high == pytest.approx(sheared(), rel=0.15)
    of_bar = [u.name for u in hold_unknowns(build_twin(sagging(), 60))]
    assert "grip_slip.compliance_m_n" not in of_bar  # a bar is no rope


def traced(compliance_m_n: float) -> TraceResult:
    scene = rope()
    twin = twin_of(scene)
    slips = twin.with_effect(effect("grip_slip", compliance_m_n=compliance_m_n))
    tracks = slips.observe(slips.simulate_nodes(*scene.control_track(), scene.times), scene.times)
    noise = np.random.default_rng(0).normal(scale=SIGMA, size=tracks.shape)
    return trace(replace(scene, points=tracks + noise), CONFIG, calibrated_twin=twin)


def test_a_hand_that_gives_as_a_sheared_rope_does_is_nothing_and_a_softer_one_is_named() -> None:
    found = traced(0.6 * sheared())
    assert found.verdict.name == "nothing_to_explain"
    assert found.declared.fitted.misfit < 1.1
    assert found.declared.fitted.value("grip_slip.compliance_m_n") == pytest.approx(0.6 * sheared(), rel=0.3)
    soft = traced(5.0 * sheared())
    assert [e.name for e in soft.effects] == ["grip_slip"]
    assert soft.effects[0].parameters["compliance_m_n"].value == pytest.approx(5.0 * sheared(), rel=0.15)


def test_a_drag_that_a_calibration_may_free_is_named_all_the_same() -> None:
    scene = rope()
    twin = twin_of(scene).with_effect(effect("air_drag_linear", rate_per_s=2.0))
    tracks = twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)
    noise = np.random.default_rng(0).normal(scale=SIGMA, size=tracks.shape)
    found = trace(
        replace(scene, points=tracks + noise), CONFIG
    )  # which calibrates the declared physics first
    assert [e.name for e in found.effects] == ["air_drag_linear"]
    assert found.effects[0].parameters["rate_per_s"].value == pytest.approx(2.0, rel=0.1)
