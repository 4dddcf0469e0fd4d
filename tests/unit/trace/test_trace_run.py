"""A trace from beginning to end on small beams that were recorded by a twin of another resolution, with noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.calibrate import CalibrationConfig
from physworld.effects.registry import effect
from physworld.errors import Cancelled
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.trace import Memory, TraceConfig, TraceResult, document, trace
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

LOW, HIGH = np.array([0.0, -0.015, -0.015]), np.array([0.16, 0.015, 0.015])
FRAMES, SIGMA, YOUNGS_MODULUS_PA = 32, 1e-3, 1.5e5
LIBRARY = ("air_drag_linear", "viscosity_kelvin_voigt", "gravity_tilt", "actuation_lag", "measurement_clock",
           "measurement_scale")  # fmt: skip
CONFIG = TraceConfig(
    calibration=CalibrationConfig(particle_budget=120, damping="none"), candidates=LIBRARY, bootstraps=200
)


def beam(stroke: float) -> Scene:
    """A bar whose clamp is moved up and down and sideways by ``stroke`` [m]."""
    times = np.arange(FRAMES) / 30.0
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    points = [[x, y, z] for x in np.linspace(0.04, 0.16, 6) for y in (-0.015, 0.015) for z in (-0.015, 0.015)]
    scene = made_scene(
        points,
        "beam",
        grip,
        FRAMES,
        body=box_body(LOW, HIGH, density_kg_m3=300.0),
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.02, 0.015, 0.015])),),
        initial_state=UNDEFORMED_AT_REST,
    )
    path = stroke * np.stack([0 * times, np.sin(9 * times), 1 - np.cos(7 * times)], axis=1)
    return replace(scene, controllers=grip + path[:, None])


def recorded(scene: Scene, *effects, sigma: float = SIGMA) -> Scene:
    """The scene as a finer twin with these effects moves in it."""
    twin: Twin = build_twin(scene, 240).with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA)
    for known in effects:
        twin = twin.with_effect(known)
    tracks = twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)
    noise = np.random.default_rng(0).normal(scale=sigma, size=tracks.shape)
    return replace(scene, points=tracks + noise, noise_sigma_m=sigma)


def traced(*effects, stroke: float = 0.015, config: TraceConfig = CONFIG) -> TraceResult:
    return trace(recorded(beam(stroke), *effects), config)


def test_where_nothing_acts_nothing_is_named() -> None:
    found = trace(recorded(beam(0.015), sigma=2 * SIGMA), CONFIG)
    assert found.verdict.name == "nothing_to_explain" and not found.effects
    assert found.better is None


def test_what_the_cells_leave_open_does_not_depend_on_where_the_trace_begins() -> None:
    scene = recorded(beam(0.03))
    config = replace(CONFIG, candidates=("air_drag_linear",))
    near, far = (
        trace(
            scene, config, calibrated_twin=build_twin(scene, 120).with_parameters(youngs_modulus_pa=modulus)
        )
        for modulus in (YOUNGS_MODULUS_PA, 1.5 * YOUNGS_MODULUS_PA)
    )
    assert far.numerics["finer cells"] == pytest.approx(near.numerics["finer cells"], rel=0.1)
    assert far.declared.fitted.misfit == pytest.approx(near.declared.fitted.misfit, rel=0.04)


def test_a_faulty_frame_and_a_marker_that_slips_are_left_out_and_told() -> None:
    scene = recorded(beam(0.03), effect("air_drag_linear", rate_per_s=6.0))
    scene.points[12] += [0.03, 0.0, 0.02]
    scene.points[9:, 5] += [0.0, 0.02, 0.0]
    report = document(trace(scene, CONFIG))
    assert [e["name"] for e in report["effects"]] == ["air_drag_linear"]
    assert "all points in frame 12, point 5 in" in report["notes"][0]


def test_where_nothing_acts_faulty_sightings_are_an_issue_of_the_data() -> None:
    scene = recorded(beam(0.015), sigma=2 * SIGMA)
    scene.points[12] += [0.05, 0.0, 0.04]
    report = document(trace(scene, CONFIG))
    assert report["verdict"] == "data_issue" and not report["effects"]
    assert "all points in frame 12" in report["reason"]


def test_points_that_training_frames_do_not_show_and_that_come_late() -> None:
    scene = recorded(beam(0.015), sigma=2 * SIGMA)
    scene.visible[: scene.train[1], 3] = False
    scene.visible[:8, 10] = False
    scene.points[~scene.visible] = 9.9
    found = trace(scene, CONFIG)
    assert found.verdict.name == "nothing_to_explain"
    assert found.declared.fitted.misfit < 1.2


def test_without_a_noise_there_is_no_claim() -> None:
    scene = recorded(beam(0.03), effect("air_drag_linear", rate_per_s=6.0))
    few = replace(scene, noise_sigma_m=None, points=scene.points[:, :3], visible=scene.visible[:, :3])
    found = trace(replace(few, train=(0, 6), test=(6, FRAMES)), CONFIG)
    assert found.sigma is None and found.verdict.name == "unexplained"
    assert "no claim" in found.verdict.reason


def test_a_drag_is_named_with_its_strength_and_the_held_out_error_falls() -> None:
    report = document(traced(effect("air_drag_linear", rate_per_s=6.0), stroke=0.03))
    assert report["verdict"] == "named" and [e["name"] for e in report["effects"]] == ["air_drag_linear"]
    rate = report["effects"][0]["parameters"]["rate_per_s"]
    assert rate["value"] == pytest.approx(6.0, rel=0.15) and rate["unit"] == "1/s"
    assert rate["ci95"][0] <= rate["value"] <= rate["ci95"][1]
    assert report["effects"][0]["posterior"] > 0.95
    assert 0.5 < report["effects"][0]["share_of_held_out_error"] <= 1.0
    assert report["remainder"]["over_noise"] < 1.3
    assert sum(h["posterior"] for h in report["hypotheses"]) == pytest.approx(1.0)
    out = report["held_out"]
    assert out["explained_fraction"] > 0.8 and out["after_ci95"][0] <= out["after"] <= out["after_ci95"][1]
    assert out["noise_floor"] == SIGMA and set(out["baselines"]) == {
        "static",
        "rigid_follow",
        "constant_velocity",
    }


def test_a_clock_that_is_off_is_a_fault_of_the_data() -> None:
    found = traced(effect("measurement_clock", offset_s=0.03))
    assert found.verdict.name == "data_issue"
    assert found.effects[0].name == "measurement_clock"
    assert found.effects[0].parameters["offset_s"].value == pytest.approx(0.03, rel=0.2)


def test_a_camera_that_is_turned_against_the_grips_is_named() -> None:
    config = replace(CONFIG, candidates=(*LIBRARY, "measurement_turn"))
    found = traced(effect("measurement_turn", x_rad=0.08, z_rad=-0.05), stroke=0.04, config=config)
    assert found.verdict.name == "data_issue" and [e.name for e in found.effects] == ["measurement_turn"]
    turned = found.effects[0].parameters
    assert turned["x_rad"].value == pytest.approx(0.08, abs=0.015)
    assert turned["z_rad"].value == pytest.approx(-0.05, abs=0.015)


def test_an_effect_outside_the_library_is_described_and_not_named() -> None:
    config = replace(CONFIG, candidates=("gravity_tilt", "measurement_scale"))
    found = traced(effect("air_drag_linear", rate_per_s=6.0), stroke=0.03, config=config)
    assert found.verdict.name == "unexplained" and not found.effects
    assert found.remainder_m > SIGMA and "over time" in found.remainder


def test_a_trace_that_was_cut_off_goes_on_from_its_memory(tmp_path: Path) -> None:
    scene = recorded(beam(0.015))
    calls = 0

    def stop() -> bool:
        nonlocal calls
        calls += 1
        return calls > 300

    memory = Memory(tmp_path)
    config = replace(CONFIG, candidates=("air_drag_linear", "measurement_scale"))
    twin = build_twin(scene, 120).with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA)
    with pytest.raises(Cancelled, match="simulations"):
        trace(scene, config, memory=memory, calibrated_twin=twin, cancelled=stop)
    remembered = {path.name for path in tmp_path.iterdir()}
    assert remembered
    again = trace(scene, config, memory=memory, calibrated_twin=twin)
    fresh = trace(scene, config, calibrated_twin=twin)
    assert np.array_equal(again.after, fresh.after) and again.verdict.name == fresh.verdict.name
    assert remembered <= {path.name for path in tmp_path.iterdir()}


def test_a_camera_finer_than_the_cells_claims_no_more_than_the_cells_allow() -> None:
    """What cells change is much more than 0.02 mm, and a drag is plain beside it all the same; to a millimetre of noise
    it is nothing."""
    scene = recorded(beam(0.015), effect("air_drag_linear", rate_per_s=2.0), sigma=2e-5)
    fine = trace(scene, CONFIG)
    assert {e.name for e in (*fine.effects, *(e for own in fine.equivalent for e in own))} >= {
        "air_drag_linear"
    }
    assert any("finer cells change the twin by" in note for note in fine.notes)
    coarse = trace(scene, replace(CONFIG, noise_m=1e-3))
    assert coarse.sigma == coarse.held_out.noise_floor == 1e-3
    assert coarse.verdict.name == "nothing_to_explain" and coarse.effects == ()
    assert any("1 mm as asked for" in note for note in coarse.notes)
    with pytest.raises(ValueError, match="noise of -1"):
        trace(scene, replace(CONFIG, noise_m=-1.0))
