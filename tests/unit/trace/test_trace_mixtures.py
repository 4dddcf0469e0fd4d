"""Two effects that act at once, and one that acts alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.calibrate import CalibrationConfig
from physworld.effects.registry import effect
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.trace import TraceConfig, TraceResult, document, trace
from physworld.trace.hypotheses import Hypothesis
from physworld.trace.starts import Begun, Starts, distinct
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

LOW, HIGH = np.array([0.0, -0.02, -0.02]), np.array([0.2, 0.02, 0.02])
FRAMES, SIGMA = 36, 1e-3
RATE_PER_S, TILT_RAD = 4.0, 0.2
CONFIG = TraceConfig(
    calibration=CalibrationConfig(particle_budget=160, damping="none"),
    candidates=("air_drag_linear", "gravity_tilt", "viscosity_kelvin_voigt"),
    bootstraps=200,
    experiment=None,
)


def shaken() -> Scene:
    """A bar with 80 tracked points whose clamp is shaken."""
    times = np.arange(FRAMES) / 30.0
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    points = [[x, y, z] for x in np.linspace(0.05, 0.2, 20) for y in (-0.02, 0.02) for z in (-0.02, 0.02)]
    scene = made_scene(
        points, "beam", grip, FRAMES, body=box_body(LOW, HIGH, density_kg_m3=400.0),
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.04, 0.02, 0.02])),), initial_state=UNDEFORMED_AT_REST,
    )  # fmt: skip
    path = 0.018 * np.stack([0 * times, np.sin(11 * times), 1 - np.cos(8 * times)], axis=1)
    return replace(scene, controllers=grip + path[:, None])


def traced(**strengths: float) -> TraceResult:
    """The trace of what a finer twin records with these effects."""
    scene = shaken()
    twin = build_twin(scene, 440).with_parameters(youngs_modulus_pa=4e4)
    if "rate_per_s" in strengths:
        twin = twin.with_effect(effect("air_drag_linear", rate_per_s=strengths["rate_per_s"]))
    if "tilt_x_rad" in strengths:
        twin = twin.with_effect(effect("gravity_tilt", tilt_x_rad=strengths["tilt_x_rad"]))
    if "viscosity_pa_s" in strengths:
        twin = twin.with_effect(effect("viscosity_kelvin_voigt", viscosity_pa_s=strengths["viscosity_pa_s"]))
    tracks = twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)
    noise = np.random.default_rng(0).normal(scale=SIGMA, size=tracks.shape)
    return trace(replace(scene, points=tracks + noise, noise_sigma_m=SIGMA), CONFIG)


def test_two_effects_are_named_together() -> None:
    found = traced(rate_per_s=RATE_PER_S, tilt_x_rad=TILT_RAD)
    assert found.verdict.name == "named"
    numbers = {e.name: e.parameters for e in found.effects}
    assert set(numbers) == {"air_drag_linear", "gravity_tilt"}
    assert numbers["air_drag_linear"]["rate_per_s"].value == pytest.approx(RATE_PER_S, rel=0.25)
    assert numbers["gravity_tilt"]["tilt_x_rad"].value == pytest.approx(TILT_RAD, rel=0.25)
    report = document(found)
    assert report["path"][1]["kept"] == ["air_drag_linear", "gravity_tilt"]
    assert report["held_out"]["after"] < 1.3 * SIGMA


def test_a_viscosity_behind_a_drag_is_named_beside_it() -> None:
    found = traced(rate_per_s=2.5, viscosity_pa_s=90.0)
    assert found.verdict.name == "named"
    numbers = {e.name: e.parameters for e in found.effects}
    assert set(numbers) == {"air_drag_linear", "viscosity_kelvin_voigt"}
    assert numbers["air_drag_linear"]["rate_per_s"].value == pytest.approx(2.5, rel=0.25)
    assert numbers["viscosity_kelvin_voigt"]["viscosity_pa_s"].value == pytest.approx(90.0, rel=0.25)


def test_places_of_one_stiffness_are_in_one_basin() -> None:
    assert distinct([9.0, 9.05, 9.2, 8.95, 10.0]) == [0, 2, 4]
    assert distinct([9.0, 9.2, 10.0], taken=[9.25]) == [0, 2]


def test_a_viscosity_that_acts_alone_stays_alone() -> None:
    found = traced(viscosity_pa_s=90.0)
    assert len(found.effects) == 1 and len(found.verdict.model.members) == 1


def test_a_drag_stays_alone_and_no_other_basin_is_looked_for_where_a_near_start_comes_near_the_noise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []

    def followed(self: Starts, base: Hypothesis, one: Begun, every: bool) -> Begun:
        asked.append(one.screened.candidate.effect)
        return follow(self, base, one, every)

    follow = Starts.followed
    monkeypatch.setattr(Starts, "followed", followed)
    found = traced(rate_per_s=4.0)
    assert [e.name for e in found.effects] == ["air_drag_linear"] and len(found.verdict.model.members) == 1
    assert asked == []
