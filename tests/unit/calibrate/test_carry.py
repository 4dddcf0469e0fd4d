"""Material of one recording on another: what belongs to the object goes along, how it was gripped is found anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene, recorded_by

from physworld.calibrate import carried_over
from physworld.errors import SceneUnsupported
from physworld.evaluate.metrics import track_error
from physworld.scene import Body, Scene
from physworld.twin.build import build_twin
from physworld.twin.rods import first_mode
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

LENGTH, FRAMES, POINTS = 0.6, 50, 7
ROLL = 2.0  # rad by which the rope is rolled in the second recording


def swung(frequency_hz: float, points: int = POINTS) -> Scene:
    """A hanging rope whose end a hand of two markers swings."""
    s = np.linspace(0.0, LENGTH, points)
    places = np.stack([np.zeros(points), np.zeros(points), -s], axis=1)
    body = Body(segment_rest_lengths_m=np.full(points - 1, LENGTH / (points - 1)), radius_m=0.004)
    scene = made_scene(places, "rope", places[:2], FRAMES, body=body)
    sway = 0.05 * np.sin(2 * np.pi * frequency_hz * scene.times)[:, None, None] * np.array([1.0, 0.4, 0.0])
    return replace(scene, controllers=scene.controllers + sway, train=(0, 35), test=(35, FRAMES))


def curved(scene: Scene, direction_rad: float) -> Twin:
    """A twin whose rope is curved towards a direction about its axis."""
    twin = build_twin(scene).with_parameters(bending_n_m2=2e-3, relaxation_s=0.02, air_drag_per_s=0.3)
    assert twin.natural is not None
    natural = twin.natural.copy()
    natural[first_mode(twin), :2] = 2.5 * np.array([np.cos(direction_rad), np.sin(direction_rad)])
    return replace(twin, natural=natural)


def test_the_roll_of_a_rope_is_found_and_its_material_kept() -> None:
    home, away = swung(1.1), swung(1.6)
    twin = curved(home, 0.0)
    recorded = recorded_by(curved(away, ROLL), away, 1e-4)
    carried = carried_over(twin, recorded)
    assert carried.law == twin.law and carried.air_drag_per_s == twin.air_drag_per_s
    times, controls = recorded.control_track()
    errors = {}
    for name, one in {"as rolled": carried, "as at home": curved(recorded, 0.0)}.items():
        tracks = one.track_nodes(one.simulate_nodes(times, controls, recorded.times))
        held_out = slice(*recorded.test)
        errors[name] = track_error(tracks[held_out], recorded.points[held_out], recorded.visible[held_out])
    assert errors["as rolled"] < 2e-3  # of a rope of 0.6 m, with 0.1 mm of noise
    assert errors["as at home"] > 10 * errors["as rolled"]


def test_a_rope_with_other_points_takes_no_natural_curvature() -> None:
    with pytest.raises(SceneUnsupported, match="nodes takes no natural curvature"):
        carried_over(curved(swung(1.1), 0.0), swung(1.1, POINTS + 8))
