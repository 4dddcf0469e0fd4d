"""Several recordings of one object: what one alone cannot tell is named with two; the held-out one is only measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.calibrate import CalibrationConfig
from physworld.effects.registry import effect
from physworld.errors import SceneUnsupported
from physworld.estimation.simulations import Job, Simulations
from physworld.materials.plastic.von_mises import VonMises
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.trace import TraceConfig, document, trace
from physworld.trace.candidates import candidates
from physworld.trace.recordings import (
    FITTED,
    HELD_OUT,
    JointSimulations,
    Recordings,
    side_by_side,
)
from physworld.trace.unknowns import with_strengths
from physworld.twin.build import build_twin, taken_over

pytestmark = pytest.mark.slow

LOW, HIGH = np.array([0.0, -0.015, -0.015]), np.array([0.16, 0.015, 0.015])
SIGMA, YOUNGS_MODULUS_PA, BUDGET = 5e-4, 1.5e5, 120
CONFIG = TraceConfig(
    calibration=CalibrationConfig(particle_budget=BUDGET, damping="none"),
    candidates=("actuation_lag", "measurement_clock"),
    bootstraps=200,
    experiment=None,
)


def beam(path: np.ndarray, name: str) -> Scene:
    """A bar whose clamp follows ``path`` (T, 3) [m]."""
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    points = [[x, y, z] for x in np.linspace(0.06, 0.16, 3) for y in (-0.015, 0.015) for z in (-0.015, 0.015)]
    scene = made_scene(
        points, "beam", grip, len(path), body=box_body(LOW, HIGH, density_kg_m3=300.0), name=name,
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.02, 0.015, 0.015])),), initial_state=UNDEFORMED_AT_REST,
    )  # fmt: skip
    return replace(scene, controllers=grip + path[:, None])


def still(frames: int, name: str = "still") -> Scene:
    return beam(np.zeros((frames, 3)), name)


def swung(frames: int, rate: float, name: str = "swung") -> Scene:
    times = np.arange(frames) / 30.0
    return beam(
        0.02 * np.stack([0 * times, np.sin(rate * times), 1 - np.cos(0.8 * rate * times)], axis=1), name
    )


def recorded(scene: Scene, *effects, seed: int = 0) -> Scene:
    """The scene as a finer twin with these effects moves in it."""
    twin = build_twin(scene, 2 * BUDGET).with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA)
    for known in effects:
        twin = twin.with_effect(known)
    tracks = twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)
    noise = np.random.default_rng(seed).normal(scale=SIGMA, size=tracks.shape)
    return replace(scene, points=tracks + noise, noise_sigma_m=SIGMA)


def test_an_effect_that_one_recording_cannot_show_is_named_with_two() -> None:
    late = effect("actuation_lag", lag_s=0.03)
    resting = recorded(still(16), late)
    moving = recorded(swung(20, 9.0), late, seed=1)
    unseen = recorded(swung(24, 7.0, "unseen"), late, seed=2)
    start = build_twin(resting, BUDGET).with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA)
    alone = trace(resting, CONFIG, calibrated_twin=start)
    assert "actuation_lag" not in [e.name for e in alone.effects]

    both = trace([resting, moving], CONFIG, held_out=[unseen], calibrated_twin=start)
    assert [e.name for e in both.effects] == ["actuation_lag"]
    assert both.effects[0].parameters["lag_s"].value == pytest.approx(0.03, rel=0.15)
    report = document(both)
    assert [(r["scene"], r["role"], r["frames"]) for r in report["recordings"]] == [
        ("still", FITTED, [11, 16]), ("swung", FITTED, [14, 20]), ("unseen", HELD_OUT, [1, 24]),
    ]  # fmt: skip
    assert report["held_out"]["before"] == report["recordings"][2]["before"]
    assert report["held_out"]["after"] < 0.5 * report["held_out"]["before"]
    assert report["recordings"][1]["after"] < 0.5 * report["recordings"][1]["before"]
    assert both.before.shape == resting.points.shape


def test_nothing_of_a_held_out_recording_but_its_start_reaches_the_fit() -> None:
    moving = recorded(swung(16, 9.0))
    unseen = recorded(swung(20, 7.0, "unseen"), seed=2)
    spoilt = replace(unseen, points=np.concatenate([unseen.points[:1], unseen.points[1:] + 0.05]))
    config = replace(CONFIG, candidates=("measurement_clock",), iterations=1)
    start = build_twin(moving, BUDGET).with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA)
    found = [trace(moving, config, held_out=[scene], calibrated_twin=start) for scene in (unseen, spoilt)]
    assert np.array_equal(found[0].recordings[1].after, found[1].recordings[1].after)
    assert found[1].held_out.before > 10 * found[0].held_out.before


def test_tracks_of_recordings_stand_side_by_side_each_under_its_own_drive() -> None:
    scenes = [swung(16, 9.0, "a"), still(24, "b")]
    recordings = Recordings(scenes, (), 12, 3)
    twin = build_twin(scenes[0], BUDGET)
    joint = JointSimulations(recordings, twin, BUDGET, 1.25)
    frames = recordings.split.train[1]
    (tracks,) = joint.run([Job(twin, frames)])
    own = [
        Simulations(r.drive).run([Job(build_twin(r.scene, BUDGET), r.split.train[1])])[0]
        for r in recordings.fitted
    ]
    assert tracks is not None and tracks.shape == (17, 24, 3) == recordings.scene.points.shape
    assert np.array_equal(tracks[:11, :12], own[0]) and np.array_equal(tracks[:, 12:], own[1])
    assert not recordings.scene.visible[11:, :12].any() and recordings.scene.visible[1:, 12:].all()
    with pytest.raises(ValueError, match="no twin of recording 1"):
        joint.run([Job(build_twin(scenes[0], BUDGET, refinement=2.0), frames)])


def test_a_tether_holds_the_same_material_of_a_body_that_starts_elsewhere() -> None:
    here = swung(16, 9.0)
    aside = np.array([0.0, 0.41, 0.0])
    body = replace(here.body, box_min_m=LOW + aside, box_max_m=HIGH + aside)
    grips = (replace(here.grips[0], region_min_m=LOW + aside, region_max_m=LOW + aside + [0.02, 0.03, 0.03]),)
    there = replace(
        here, points=here.points + aside, controllers=here.controllers + aside, body=body, grips=grips
    )
    lead, other = (build_twin(scene, BUDGET) for scene in (here, there))
    tied = candidates(lead, ("tether",))[0][3].prepared(lead)
    tied = with_strengths(tied, "tether", {"stiffness_n_m": 5.0})
    carried = taken_over(tied, other)
    (one, second) = (known.effects[0].places(known) for known in (tied, carried))
    np.testing.assert_allclose(second[1], one[1] + aside, atol=1e-9)
    np.testing.assert_allclose(second[0], one[0], atol=1e-12)  # the anchor stands in the room
    shown = tied.effects[0].placed(carried).values
    assert shown["attach_y_m"] == pytest.approx(0.41, abs=1e-9) and shown["attach_x_m"] > 0.14
    explicit = tied.effects[0].placed(tied)
    assert replace(carried, effects=(explicit,)).effects[0].places(carried)[1] == pytest.approx(one[1])


def test_other_recordings_flow_as_the_first_one_does() -> None:
    scenes = [swung(16, 9.0), swung(16, 7.0)]
    lead = build_twin(
        scenes[0], BUDGET, plasticity=VonMises(yield_stress_pa=200.0), formulation="updated_lagrangian",
        transfer="asflip",
    )  # fmt: skip
    simulations = JointSimulations(Recordings(scenes, [], 12, 3), lead, BUDGET, 1.25)
    both = simulations.run([Job(lead, 8)])[0]
    own = build_twin(
        scenes[1], BUDGET, plasticity=lead.plasticity, formulation=lead.formulation, transfer="asflip"
    )
    own = replace(own, law=lead.law)
    alone = own.observe(
        own.simulate_nodes(*scenes[1].control_track(), scenes[1].times[:8]), scenes[1].times[:8]
    )
    assert np.array_equal(both[:, -alone.shape[1] :], alone)


def test_a_recording_that_ended_repeats_its_last_frame() -> None:
    short, long = np.arange(2.0)[:, None, None] * np.ones((1, 1, 3)), np.zeros((4, 2, 3))
    both = side_by_side([short, long], 4)
    assert both.shape == (4, 3, 3) and both[:, 0, 0].tolist() == [0.0, 1.0, 1.0, 1.0]


def test_recordings_of_different_kinds_are_refused() -> None:
    with pytest.raises(SceneUnsupported, match=r"beam.*rope"):
        Recordings([still(8), replace(still(8), kind="rope")], (), 12, 3)
    with pytest.raises(SceneUnsupported, match="it has 0 and 1 held out"):
        Recordings([], [still(8)], 12, 3)
