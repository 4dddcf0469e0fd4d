"""Where tracked points lie in a body that was measured as it was: found by all training frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sagging_bar import BUDGET, TRUE_PA, sagging

from physworld.calibrate import CalibrationConfig, calibrate, carried_over
from physworld.calibrate.places import PLACE_SHARE, placed_as_seen
from physworld.estimation.whitening import moved
from physworld.evaluate.metrics import track_error
from physworld.scene import AS_MEASURED, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

Array = np.ndarray
FRAMES, SIGMA = 40, 5e-5


def recording(shift: Array | float = 0.0, wobble_m: float = 0.0) -> tuple[Scene, Twin, Array]:
    """A bar whose points lie ``shift`` away in it from where its first frame shows them, the twin that this frame
    gives, and its motion; an error that dies away is in every sighting."""
    begun = sagging(frames=FRAMES)
    twin = build_twin(begun, BUDGET).with_parameters(youngs_modulus_pa=TRUE_PA)
    nodes = twin.simulate_nodes(*begun.control_track(), begun.times)
    rng = np.random.default_rng(0)
    seen = moved(twin, np.broadcast_to(shift, (len(twin.body.points), 3))).observe(nodes, begun.times)
    dying = np.exp(-np.arange(FRAMES) / 6.0) * np.cos(1.3 * np.arange(FRAMES))
    seen += wobble_m * dying[:, None, None] + rng.normal(scale=SIGMA, size=seen.shape)
    seen[0] = begun.points[0]
    scene = replace(begun, points=seen, initial_state=AS_MEASURED, noise_sigma_m=SIGMA)
    return scene, twin, nodes


def shifts() -> Array:
    return np.random.default_rng(3).normal(scale=5e-4, size=sagging(frames=2).points[0].shape)


def held_out(scene: Scene, tracks: Array) -> float:
    frames = slice(*scene.test)
    return track_error(tracks[frames], scene.points[frames], scene.visible[frames])


def test_places_are_found_beside_an_error_of_the_model_that_dies_away() -> None:
    scene, twin, nodes = recording(shifts(), wobble_m=2e-3)
    found = placed_as_seen(scene, twin, nodes)
    assert np.abs(found.body.points - twin.body.points - shifts()).max() < 2e-4
    assert held_out(scene, found.observe(nodes, scene.times)) < 3.0 * SIGMA
    early = placed_as_seen(scene, twin, nodes[: scene.train[1]])  # nothing but training frames enters
    assert np.array_equal(early.body.points, found.body.points)


def test_a_start_without_deformation_keeps_its_places() -> None:
    scene, twin, nodes = recording(shifts())
    undeformed = replace(scene, initial_state=sagging(frames=2).initial_state)
    assert placed_as_seen(undeformed, twin, nodes) is twin


def test_points_that_nothing_shows_stay_and_far_shifts_are_held_back() -> None:
    scene, twin, nodes = recording(shifts())
    hidden = scene.visible.copy()
    hidden[1:, 2] = False
    found = placed_as_seen(replace(scene, visible=hidden), twin, nodes)
    assert np.abs(found.body.points - twin.body.points)[2].max() < 1e-6
    first = np.concatenate([scene.points[0], scene.controllers[0]])
    deviation = PLACE_SHARE * np.linalg.norm(np.ptp(first, axis=0))
    wild = 10.0 * deviation * np.random.default_rng(1).normal(size=scene.points.shape)
    found = placed_as_seen(replace(scene, points=scene.points + wild), twin, nodes)
    assert np.abs(found.body.points - twin.body.points).max() < 4.0 * deviation


@pytest.mark.slow
def test_a_calibration_places_points_and_so_does_material_that_is_carried_over() -> None:
    scene, _, _ = recording(shifts())
    config = CalibrationConfig(particle_budget=BUDGET, max_simulations=60)
    found = calibrate(scene, config)
    first = calibrate(scene, replace(config, placed=False))
    assert found.parameters["youngs_modulus_pa"].value == pytest.approx(TRUE_PA, rel=2e-4)
    assert held_out(scene, first.tracks) > 5e-4 and held_out(scene, found.tracks) < 3.0 * SIGMA
    carried = carried_over(found.twin, scene, BUDGET)
    nodes = carried.simulate_nodes(*scene.control_track(), scene.times)
    assert held_out(scene, carried.observe(nodes, scene.times)) < 3.0 * SIGMA
