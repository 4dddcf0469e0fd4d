"""Effects of the measurement, exactly; and the lag of the grip, which looks like one of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_twins import SCENES, TWINS, simulated

from physworld.effects.registry import effect
from physworld.twin.build import build_twin

TIMES = np.linspace(0.0, 2.0, 41)
TWIN = TWINS["rope"]


def line(velocity: tuple[float, float, float] = (1.0, -2.0, 0.5)) -> np.ndarray:
    """Two points at constant velocity, (41, 2, 3)."""
    start = np.array([[0.0, 0.1, 0.2], [0.3, 0.4, 0.5]])
    return start + TIMES[:, None, None] * np.array(velocity)


def test_scale_stretches_solids_about_the_controllers_and_thin_bodies_about_every_points_start() -> None:
    tracks, solid = line(), TWINS["solid"]
    seen = effect("measurement_scale", scale=0.1).measured(TIMES, tracks, solid)
    centre = solid.controllers_start.mean(axis=0)
    np.testing.assert_allclose(seen, centre + 1.1 * (tracks - centre), atol=1e-15)
    middle = np.array([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0]])
    other = replace(solid, controllers_start=middle)
    fixed = effect("measurement_scale", scale=-0.2).measured(TIMES, np.full((41, 1, 3), 2.0), other)
    np.testing.assert_allclose(fixed, 2.0, atol=1e-15)
    start = TWIN.track_nodes(TWIN.body.start[None])
    moved = start + 0.3 * TIMES[:, None, None]
    seen = effect("measurement_scale", scale=0.1).measured(TIMES, moved, TWIN)
    np.testing.assert_allclose(seen, start + 0.33 * TIMES[:, None, None], atol=1e-14)


@pytest.mark.parametrize("name", SCENES)
def test_a_scale_that_is_off_leaves_the_first_frame_as_it_was_measured(name: str) -> None:
    twin = TWINS[name]
    nodes = twin.body.start[None]
    seen = twin.with_effect(effect("measurement_scale", scale=0.1)).observe(nodes, TIMES[:1])
    np.testing.assert_allclose(seen, twin.track_nodes(nodes), atol=1e-12)


@pytest.mark.parametrize("share", [0.05, -0.08])
def test_a_recording_that_is_scaled_in_every_frame_is_what_the_effect_predicts(share: float) -> None:
    scene = SCENES["solid"]()
    truth = replace(TWINS["solid"], gravity_m_s2=np.array([0.0, -4.0, -9.81]), ground_height_m=None)
    truth = truth.with_parameters(youngs_modulus_pa=2e4)
    tracks = truth.observe(simulated(truth, scene), scene.times)
    grip = truth.controllers_start.mean(axis=0)
    camera = grip + (1.0 + share) * (tracks - grip)
    body = build_twin(replace(scene, points=camera), 300).body
    twin = replace(truth, body=replace(body, start_velocity=truth.body.start_velocity))
    nodes = simulated(twin, scene)
    error = np.abs(
        twin.with_effect(effect("measurement_scale", scale=share)).observe(nodes, scene.times) - camera
    )
    assert np.abs(twin.observe(nodes, scene.times) - camera).max() > 5e-4
    assert error.max() < 1e-9


def test_a_late_clock_shows_the_past_and_an_early_one_the_future() -> None:
    tracks = line()
    late = effect("measurement_clock", offset_s=0.12).measured(TIMES, tracks, TWIN)
    expected = tracks[0] + np.maximum(TIMES - 0.12, 0.0)[:, None, None] * np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(late, expected, atol=1e-12)
    early = effect("measurement_clock", offset_s=-0.12).measured(TIMES, tracks, TWIN)
    np.testing.assert_allclose(early, tracks + 0.12 * np.array([1.0, -2.0, 0.5]), atol=1e-12)
    swing = np.sin(3.0 * TIMES)[:, None, None] * np.ones((1, 1, 3))
    seen = effect("measurement_clock", offset_s=0.12).measured(TIMES, swing, TWIN)[4:]
    np.testing.assert_allclose(seen, np.sin(3.0 * (TIMES[4:] - 0.12))[:, None, None] * np.ones(3), atol=5e-3)


def test_drift_grows_in_time() -> None:
    seen = effect("measurement_drift", x_m_s=0.1, y_m_s=-0.2, z_m_s=0.05).measured(TIMES, line(), TWIN)
    np.testing.assert_allclose(seen, line((1.1, -2.2, 0.55)), atol=1e-14)


def test_smoothing_follows_a_ramp_a_time_constant_late() -> None:
    tau, velocity = 0.2, np.array([1.0, -2.0, 0.5])
    seen = effect("measurement_smoothing", time_constant_s=tau).measured(TIMES, line(), TWIN)
    behind = tau * (1 - np.exp(-TIMES / tau))[:, None, None] * velocity
    np.testing.assert_allclose(seen, line() - behind, atol=1e-13)
    step = np.ones((41, 1, 3))
    step[0] = 0.0
    settled = effect("measurement_smoothing", time_constant_s=tau).measured(TIMES, step, TWIN)
    assert settled[-1, 0, 0] == pytest.approx(1.0, abs=1e-3) and settled[1, 0, 0] < 0.3


def test_one_frame_is_measured_as_it_is() -> None:
    first = line()[:1]
    for name in ("measurement_clock", "measurement_drift", "measurement_smoothing"):
        added = effect(name)
        added = effect(name, **dict.fromkeys(added.gates, 0.1))
        np.testing.assert_allclose(added.measured(TIMES[:1], first, TWIN), first, atol=1e-15)


def test_the_camera_scales_before_it_drifts_whatever_came_first() -> None:
    scale, drift = effect("measurement_scale", scale=0.1), effect("measurement_drift", x_m_s=0.3)
    nodes = TWIN.body.start + 0.05 * TIMES[:, None, None]
    one = TWIN.with_effect(scale).with_effect(drift).observe(nodes, TIMES)
    other = TWIN.with_effect(drift).with_effect(scale).observe(nodes, TIMES)
    np.testing.assert_array_equal(one, other)
    start = TWIN.track_nodes(nodes)[:1]
    expected = start + 1.1 * (TWIN.track_nodes(nodes) - start)
    expected[..., 0] += 0.3 * TIMES[:, None]
    np.testing.assert_allclose(one, expected, atol=1e-14)
    assert np.array_equal(TWIN.with_effect(scale).track_nodes(nodes), TWIN.track_nodes(nodes))


@pytest.mark.parametrize("name", SCENES)
def test_a_lag_of_two_frames_shifts_the_response_by_two_frames(name: str) -> None:
    twin = replace(TWINS[name], gravity_m_s2=np.zeros(3), ground_height_m=None)
    times = np.arange(12) / 30.0
    fine = np.linspace(0.0, times[-1], 111)
    sway = 0.02 * np.sin(8.0 * fine)[:, None, None] ** 2 * np.array([0.5, 1.0, 1.0])
    controls = twin.controllers_start + sway
    plain = twin.simulate_nodes(fine, controls, times)
    lagged = twin.with_effect(effect("actuation_lag", lag_s=2.0 / 30.0))
    late = lagged.simulate_nodes(fine, controls, times)
    assert np.abs(plain - twin.body.start).max() > 5e-3
    np.testing.assert_allclose(late[2:], plain[:-2], atol=2e-5)
    np.testing.assert_allclose(late[:2], np.repeat(twin.body.start[None], 2, axis=0), atol=2e-5)


def test_a_lag_between_samples_is_interpolated() -> None:
    twin = TWINS["solid"]
    times = np.arange(20) / 30.0
    controls = twin.controllers_start + 0.02 * np.sin(5.0 * times)[:, None, None] ** 2 * np.array([1.0, 0, 0])
    late = twin.with_effect(effect("actuation_lag", lag_s=0.021)).simulate_nodes(times, controls, times)
    held = twin.held_nodes[0]
    expected = 0.02 * np.sin(5.0 * np.maximum(times - 0.021, 0.0)) ** 2
    shift = late[:, held, 0] - twin.body.start[held, 0]
    np.testing.assert_allclose(shift, np.repeat(expected[:, None], len(held), axis=1), atol=1.5e-4)
