"""A sheet that hangs from a bar: where its tracked points are, what is held, what is no such sheet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_scene import made_scene

from physworld.geometry.hung_sheet import hangs_from_a_bar, hung_sheet
from physworld.scene import AS_MEASURED, Body, Scene
from physworld.twin.build import build_twin

SIDE, COUNT, INSET = 0.3, 6, 0.015
NOISE_M = 1e-3


def hung(noise: float = 0.0) -> Scene:
    """A grid whose nodes lie ``INSET`` inside the sheet's edges; its controllers are the grid's upper corners."""
    across = np.linspace(INSET, SIDE - INSET, COUNT)
    x, down = np.meshgrid(across, across, indexing="ij")
    points = np.stack([x.ravel(), np.zeros(x.size), -down.ravel()], axis=1)
    scene = made_scene(
        points,
        "sheet",
        np.array([[INSET, 0.0, -INSET], [SIDE - INSET, 0.0, -INSET]]),
        20,
        body=Body(side_m=SIDE, grid_shape=(COUNT, COUNT)),
        initial_state=AS_MEASURED,
    )
    return replace(
        scene, points=scene.points + np.random.default_rng(0).normal(0.0, noise, scene.points.shape)
    )


def test_points_keep_their_places_within_the_edges() -> None:
    body = hung_sheet(hung(), 2000, 1.0)
    assert np.abs(body.points.min(axis=0) - INSET).max() < 1e-3
    assert np.abs(body.points.max(axis=0) - (SIDE - INSET)).max() < 1e-3


def test_noise_of_the_first_frame_neither_stretches_nor_bends_the_sheet() -> None:
    body = hung_sheet(hung(NOISE_M), 2000, 1.0)
    gaps = np.linalg.norm(body.start[:, None] - body.start[None], axis=2)
    np.testing.assert_allclose(gaps, np.linalg.norm(body.rest[:, None] - body.rest[None], axis=2), atol=1e-12)
    assert not body.start_velocity.any()


def test_the_first_frame_is_predicted_within_the_noise_of_the_still_frames() -> None:
    scene = hung(NOISE_M)
    twin = build_twin(scene)
    seen = twin.track_nodes(twin.carriers_start[None])[0]
    assert np.abs(seen - hung().points[0]).max() < 2.0 * NOISE_M


def test_a_bar_holds_the_upper_edge_as_one_grip() -> None:
    twin = build_twin(hung())
    assert len(twin.held_nodes) == 1
    start = twin.body.start
    held = twin.held_nodes[0]
    assert start[held, 2].min() > np.delete(start[:, 2], held).max()


def test_what_lies_or_is_declared_at_rest_does_not_hang() -> None:
    scene = hung()
    assert hangs_from_a_bar(scene)
    assert not hangs_from_a_bar(replace(scene, initial_state="undeformed"))
    flat = scene.points[:, :, [0, 2, 1]]
    assert not hangs_from_a_bar(replace(scene, points=flat))
