"""A recording and its twin as the world model sees them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_scene import tiny_thing

from physworld.twin.build import build_twin
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.scene_view import view_scene

CONFIG = WorldModelConfig(hidden=16, message_passing_steps=1, vertices=60)
OFFSET_M = 0.01


@pytest.mark.parametrize("kind", ["rope", "sheet"])
def test_points_beside_a_thin_body_are_read_as_the_twin_has_them(kind: str) -> None:
    scene = tiny_thing(kind, frames=40)
    twin = build_twin(scene, 200)
    if kind == "sheet":  # stiff enough not to crumple
        twin = twin.with_parameters(bending_n_m=20.0 * twin.parameters["bending_n_m"])
    offsets = np.zeros_like(twin.body.offsets)
    offsets[:, -1] = OFFSET_M
    beside = replace(twin, body=replace(twin.body, offsets=offsets))
    view = view_scene(scene, beside, CONFIG)
    turned = view.twin_tracks - view_scene(scene, twin, CONFIG).twin_tracks
    assert np.linalg.norm(turned, axis=2) == pytest.approx(OFFSET_M)
    assert np.linalg.norm(turned - turned[0], axis=2).max() > 0.5 * OFFSET_M, "nothing turns"
    assert view.skin_error_m < 0.05 * OFFSET_M
    within = replace(view.skin, beside=None)
    error = np.linalg.norm(within.apply(view.vertices) - view.twin_tracks, axis=2)
    assert error.mean() == pytest.approx(OFFSET_M, rel=0.1)
