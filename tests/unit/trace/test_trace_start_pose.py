"""The pose that noisy first points give a rope: how uncertain, about which axes, and that it is no tilted gravity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.estimation.noise import freeze
from physworld.estimation.simulations import Drive, Job, nodes_of
from physworld.estimation.whitening import responses, turned_starts, whitener
from physworld.scene import AS_MEASURED, UNDEFORMED_AT_REST, Body, Scene
from physworld.twin.build import build_twin

SIGMA, LENGTH, FRAMES = 1e-3, 0.4, 24
MARKERS = np.linspace(0.05, LENGTH, 8)


def rope(**facts) -> Scene:
    points = np.stack([0 * MARKERS, 0 * MARKERS, -MARKERS], axis=1)
    body = Body(length_m=LENGTH, radius_m=0.004, density_kg_m3=900.0)
    known = {"body": body, "initial_state": UNDEFORMED_AT_REST, **facts}
    return made_scene(points, "rope", [[0.0, 0.0, 0.0]], FRAMES, **known)


def test_a_rope_turns_about_the_two_axes_across_it_by_noise_over_its_lever() -> None:
    scene = rope()
    twin = build_twin(scene)
    turned = turned_starts(scene, twin, SIGMA)
    assert len(turned) == 2
    expected = SIGMA / np.linalg.norm(MARKERS - MARKERS.mean())
    along = twin.body.start[-1] - twin.body.start[0]
    for other in turned:
        way = other.body.start[-1] - other.body.start[0]
        angle = np.arccos(way @ along / (np.linalg.norm(way) * np.linalg.norm(along)))
        assert angle == pytest.approx(expected, rel=1e-3)
        first = other.track_nodes(other.body.start[None])[0]
        np.testing.assert_allclose(first, twin.track_nodes(twin.body.start[None])[0], atol=1e-9)


def test_a_start_that_is_known_without_noise_or_fitted_is_left_alone() -> None:
    scene = rope()
    twin = build_twin(scene)
    cloud = np.repeat(scene.points[0], 3, axis=0)
    assert turned_starts(replace(scene, rest_volume_points=cloud), twin, SIGMA) == []
    assert turned_starts(replace(scene, initial_state=AS_MEASURED), twin, SIGMA) == []
    bar = made_scene([[0.1, 0.0, 0.0]], "beam", body=box_body([0, 0, 0], [0.2, 0.05, 0.05]))
    assert turned_starts(bar, build_twin(bar, 50), SIGMA) == []


def test_a_start_that_noise_has_turned_leaves_no_residual() -> None:
    scene = rope()
    twin = build_twin(scene).with_parameters(bending_n_m2=2e-4)
    truth = turned_starts(scene, twin, 1.5 * SIGMA)[0]
    drive = Drive(*scene.control_track(), scene.times)
    measured = truth.track_nodes(nodes_of(Job(truth, FRAMES), drive))
    frames = scene.train[1]
    nodes = nodes_of(Job(twin, frames), drive)
    tracks = twin.track_nodes(nodes)
    seen = replace(scene, points=measured)
    plain = whitener(seen, freeze(seen, 4, 3), SIGMA, responses(twin, nodes))
    jobs = [Job(other, frames) for other in turned_starts(scene, twin, SIGMA)]
    turns = [other.twin.track_nodes(nodes_of(other, drive)) - tracks for other in jobs]
    before, after = plain.residual(tracks), plain.knowing(turns).residual(tracks)
    assert np.linalg.norm(after) < 0.3 * np.linalg.norm(before) and np.linalg.norm(after) < 1.5
