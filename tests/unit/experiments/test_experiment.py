"""Experiments for models that a recording cannot tell apart, on a small beam: what is proposed must settle it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.calibrate import CalibrationConfig
from physworld.calibrate.parameters import parameters_of
from physworld.demonstrate.limits import limits_of
from physworld.demonstrate.motion import broken_limit
from physworld.effects.registry import effect
from physworld.estimation.noise import Split
from physworld.estimation.refit import Refit, refit
from physworld.estimation.simulations import Drive, Job, Simulations, nodes_of
from physworld.estimation.unknowns import Unknown
from physworld.estimation.whitening import responses, whitener
from physworld.experiments import Experiment, ExperimentConfig, Rival, propose
from physworld.experiments.probing import COORDINATES, motion_of, nudged, random_probe
from physworld.experiments.rivals import reconciled, refit_of
from physworld.experiments.search import clock_of
from physworld.report import render
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.trace import TraceConfig, document, trace
from physworld.trace.unknowns import of_parameter, of_strength
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

LOW, HIGH = np.array([0.0, -0.015, -0.015]), np.array([0.16, 0.015, 0.015])
FRAMES, SIGMA, YOUNGS_MODULUS_PA = 30, 5e-4, 4e4
NAMES = ("air_drag_linear", "viscosity_kelvin_voigt")
CONFIG = ExperimentConfig(draws=8, refinements=1, contenders=1, simulations=40)


def gentle_beam(**facts) -> Scene:
    """A bar without weight whose clamp makes one small step; it rings on in its first mode."""
    times = np.arange(FRAMES) / 30.0
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    points = [[x, y, z] for x in np.linspace(0.04, 0.16, 5) for y in (-0.015, 0.015) for z in (-0.015, 0.015)]
    scene = made_scene(
        points,
        "beam",
        grip,
        FRAMES,
        body=box_body(LOW, HIGH, density_kg_m3=300.0),
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.02, 0.015, 0.015])),),
        initial_state=UNDEFORMED_AT_REST,
        gravity_m_s2=np.zeros(3),
        **facts,
    )
    step = 0.004 * (0.5 - 0.5 * np.cos(np.pi * np.clip(times / 0.2, 0.0, 1.0)))
    return replace(scene, controllers=grip + step[:, None, None] * np.array([0.0, 0.0, 1.0]))


def recorded(scene: Scene, twin: Twin, seed: int) -> Scene:
    """The scene as the twin moves in it, with noise."""
    tracks = twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)
    noise = np.random.default_rng(seed).normal(scale=SIGMA, size=tracks.shape)
    return replace(scene, points=tracks + noise, visible=np.ones(tracks.shape[:2], bool), noise_sigma_m=SIGMA)


def refitted(scene: Scene, twin: Twin, unknowns: list[Unknown], starts=None) -> Refit:
    """Stiffness and strength on all frames."""
    split = Split((1, scene.frame_count), (0, 0), np.array([1, scene.frame_count]))
    simulations = Simulations(Drive(*scene.control_track(), scene.times))
    nodes = nodes_of(Job(twin, scene.frame_count), simulations.drive)
    white = whitener(scene, split, SIGMA, responses(twin, nodes))
    found = refit(simulations, white, twin, unknowns, scene.frame_count, 3, starts)
    assert found is not None
    return found


def rival(scene: Scene, twin: Twin, name: str) -> tuple[Rival, Refit]:
    """The twin with that effect, refitted to the scene."""
    stiffness = next(
        p
        for p in parameters_of(twin, separate_bending=False, damping=False, ground_friction=False)
        if p.name == "youngs_modulus_pa"
    )
    gate = next(s for s in effect(name).strengths(twin) if s.gate)
    unknowns = [of_parameter(stiffness, twin, None), of_strength(name, gate)]
    found = refitted(scene, twin, unknowns, [np.array([unknowns[0].start, 20 * k]) for k in (1.0, 4.0)])
    information = found.jacobian.T @ found.jacobian
    return Rival((name,), found.twin, tuple(found.unknowns), information, found.residual), found


def repeated(scene: Scene, proposed: Experiment, truth: Twin, seed: int) -> Scene:
    """The proposed experiment, made with a body that is ``truth``."""
    frames = len(proposed.frame_times_s)
    every = (len(proposed.times_s) - 1) // (frames - 1)
    scene = replace(
        scene,
        times=proposed.frame_times_s,
        controllers=proposed.controllers[::every],
        control_times=proposed.times_s,
        control_points=proposed.controllers,
        train=(0, frames),
        test=(frames, frames),
    )
    return recorded(scene, truth, seed)


@pytest.mark.slow
def test_the_proposed_experiment_tells_drag_from_viscosity_where_the_recording_does_not() -> None:
    scene = gentle_beam()
    twin = build_twin(scene, 60).with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA)
    scene = recorded(scene, twin.with_effect(effect("air_drag_linear", rate_per_s=1.5)), seed=1)
    rivals, fits = zip(*(rival(scene, twin, name) for name in NAMES), strict=True)
    assert abs(fits[0].misfit - fits[1].misfit) < 0.02 and max(f.misfit for f in fits) < 1.1
    proposed = propose(scene, list(rivals), SIGMA, config=CONFIG)
    assert proposed.separates and proposed.recording_sigmas is not None
    assert proposed.separation_sigmas > 5.0 > proposed.recording_sigmas
    assert proposed.simulations <= CONFIG.simulations + 1
    limits = limits_of(scene, twin)
    assert broken_limit(proposed.controllers, limits, proposed.times_s) is None
    for seed, (truth, wrong) in enumerate((rivals, rivals[::-1])):
        made = repeated(scene, proposed, truth.twin, seed)
        right = refitted(made, truth.twin, list(truth.unknowns)).misfit
        other = refitted(made, wrong.twin, list(wrong.unknowns)).misfit
        assert right < 1.1 and other > 2.0


def test_a_lag_and_a_clock_that_is_off_cannot_be_told_apart_by_any_motion() -> None:
    scene = gentle_beam()
    twin = build_twin(scene, 60).with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA)
    late = effect("actuation_lag", lag_s=0.03), effect("measurement_clock", offset_s=0.03)
    rivals = [Rival((e.name,), twin.with_effect(e)) for e in late]
    proposed = propose(scene, rivals, SIGMA, config=replace(CONFIG, refinements=0))
    assert not proposed.separates and proposed.description.startswith("No motion of the grips")
    assert "flash" in proposed.description and "marker on the grip" in proposed.description


def test_a_body_that_nothing_holds_gets_no_motion_and_advice() -> None:
    points = [[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)]
    body = box_body([0, 0, 0], [0.1, 0.1, 0.1], density_kg_m3=1000.0)
    scene = made_scene(points, "block", np.zeros((0, 3)), 6, body=body)
    twin = build_twin(scene, 60)
    rivals = [Rival((name,), twin) for name in ("wind", "gravity_tilt")]
    proposed = propose(scene, rivals, SIGMA)
    assert not proposed.separates and proposed.motion is None and proposed.simulations == 0
    assert "Nothing holds" in proposed.description and "plumb line" in proposed.description
    assert json.loads(json.dumps(proposed.document(), allow_nan=False))["controllers"] == []
    with pytest.raises(ValueError, match="1 rivals"):
        propose(scene, rivals[:1], SIGMA)


@pytest.mark.parametrize("family", COORDINATES)
def test_every_probe_and_its_neighbours_keep_the_limits(family: str) -> None:
    scene = gentle_beam()
    twin = build_twin(scene, 60)
    limits, rng = limits_of(scene, twin), np.random.default_rng(3)
    _, times = clock_of(scene, 3.0)
    for _ in range(5):
        probe = nudged(random_probe(family, limits, rng), 0.5, rng)
        assert np.all((probe.coordinates >= 0) & (probe.coordinates <= 1))
        motion = motion_of(probe, twin.controllers_start, limits, times)
        assert broken_limit(motion.points, limits, times) is None
        assert np.allclose(motion.points[0], twin.controllers_start)
        assert (np.ptp(motion.points, axis=0).max() > 1e-4) == (family != "hold")
        assert "the grip" in motion.words


def test_the_separation_is_what_no_refit_hides() -> None:
    rng = np.random.default_rng(0)
    slope, gap, away = rng.normal(size=(50, 3)), rng.normal(size=50), rng.normal(size=3)
    prior = np.diag([4.0, 1.0, 9.0])
    rows, ends = np.vstack([slope, np.sqrt(prior)]), np.concatenate([gap, -np.sqrt(prior) @ away])
    x = np.linalg.lstsq(rows, ends, rcond=None)[0]
    change, left = refit_of(gap, slope, prior, away)
    assert np.allclose(change, x, rtol=1e-6) and left == pytest.approx(
        np.linalg.norm(ends - rows @ x), rel=1e-6
    )
    assert (
        refit_of(gap, slope, None)[1] < refit_of(gap, slope, prior)[1] < refit_of(gap, slope[:, :0], None)[1]
    )
    assert refit_of(slope @ np.ones(3), slope, None)[1] < 1e-3 * np.linalg.norm(slope @ np.ones(3))


def test_rivals_that_differ_in_what_the_recording_leaves_open_are_brought_together() -> None:
    twin = build_twin(gentle_beam(), 60).with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA)
    drag = effect("air_drag_linear")
    rate = next(s for s in drag.strengths(twin) if s.gate)
    soft = Unknown("soft", "Pa", 1e3, 9e4, lambda t, v: t.with_parameters(youngs_modulus_pa=v), start=4e4)
    gate = of_strength(drag.name, rate).starting(20.0)
    first = Rival(("tether",), twin, (soft.starting(5e4),))
    other = Rival((drag.name,), twin, (soft, gate), np.diag([1.0, 4.0]))

    def basin(there: Twin) -> float:
        return 100.0 + abs(there.parameters["youngs_modulus_pa"] - 4e4) * slope

    slope = 1e-5
    together = reconciled([first, other], basin)[1]
    assert together.start == pytest.approx([5e4, 20.0]) and together.twin.effects[0].active
    assert together.twin.parameters["youngs_modulus_pa"] == pytest.approx(5e4)
    slope = 1.0
    assert reconciled([first, other], basin)[1] is other
    assert reconciled([first, other], None) == [first, other]


@pytest.mark.slow
def test_a_trace_of_an_equivalent_set_carries_the_answer_to_what_to_do_next() -> None:
    scene = gentle_beam(train=(0, FRAMES - 6), test=(FRAMES - 6, FRAMES))
    twin = build_twin(scene, 60).with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA)
    scene = recorded(scene, twin.with_effect(effect("actuation_lag", lag_s=1.0 / 30.0)), seed=2)
    names = ("actuation_lag", "measurement_clock")
    calibration = CalibrationConfig(particle_budget=60, damping="none")
    few = replace(CONFIG, draws=5, refinements=0)
    config = TraceConfig(calibration=calibration, candidates=names, experiment=few, bootstraps=100)
    result = trace(scene, config, calibrated_twin=twin)
    report = document(result)
    assert report["verdict"] == "equivalent_set"
    assert {e["name"] for e in report["effects"] + report["equivalent"]} == set(names)
    assert report["split"] == {"train": [1, FRAMES - 6], "test": [FRAMES - 6, FRAMES]}
    proposed = report["suggested_experiment"]
    assert not proposed["separates"] and proposed["simulations"] > 0
    assert proposed["recording_sigmas"] < 5.0 and "flash" in proposed["description"]
    assert report["simulations"] > proposed["simulations"]
    assert "No motion of the grips" in render(report, scene, result.before, result.after)
