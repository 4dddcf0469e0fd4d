"""Loads and clamps that a scene declares or shows: what the twin makes of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.errors import SceneUnsupported
from physworld.geometry.declared import grips_of, load_of
from physworld.scene import UNDEFORMED_AT_REST, DeclaredCollider, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

LOW, HIGH = np.array([-0.12, 0.0, 0.0]), np.array([0.0, 0.02, 0.02])
BESIDE = np.array([[-0.118, -0.01, 0.0], [-0.118, 0.03, 0.0], [-0.118, 0.03, 0.02]])
LOAD_KG = 0.02


def bar(controllers: np.ndarray = BESIDE, frames: int = 40, **load: Any) -> Scene:
    """A bar whose clamp shows by markers beside its end; ``load`` is its declared tip load."""
    return made_scene(
        [[x, 0.01, 0.02] for x in (-0.06, 0.0)],
        "beam",
        controllers,
        frames,
        body=box_body(LOW, HIGH, density_kg_m3=1000.0),
        initial_state=UNDEFORMED_AT_REST,
        declared={"body": {"tip_load": load}} if load else {},
    )


def static_sag(scene: Scene, modulus: float) -> float:
    """How far the tip hangs below its start once a strong drag has stopped it [m]."""
    twin = build_twin(scene, 600).with_parameters(
        youngs_modulus_pa=modulus, poissons_ratio=0.0, air_drag_per_s=25.0
    )
    times = np.linspace(0.0, 1.0, scene.frame_count)
    nodes = twin.simulate_nodes(scene.times, scene.controllers, times)
    tracks = twin.track_nodes(nodes)
    return float(tracks[0, 1, 2] - tracks[-1, 1, 2])


def test_still_markers_beside_a_box_bond_its_nearest_end() -> None:
    (grip,) = grips_of(bar())
    assert grip.controllers == (0, 1, 2)
    np.testing.assert_array_equal(grip.region_min_m, LOW)
    np.testing.assert_array_equal(grip.region_max_m, [LOW[0], HIGH[1], HIGH[2]])
    (other,) = grips_of(bar(BESIDE + np.array([0.116, 0.0, 0.0])))
    np.testing.assert_array_equal(other.region_min_m, [HIGH[0], LOW[1], LOW[2]])


def test_markers_in_the_body_or_in_motion_are_no_bond() -> None:
    assert grips_of(bar(BESIDE + np.array([0.0, 0.015, 0.005]))) == ()
    moving = bar()
    path = moving.controllers + np.linspace(0.0, 0.01, moving.frame_count)[:, None, None]
    assert grips_of(replace(moving, controllers=path)) == ()


def test_a_controller_that_carries_a_collider_is_no_marker_of_a_clamp() -> None:
    pusher = DeclaredCollider("peg", "sphere", radius_m=0.01, controllers=(0, 1, 2))
    assert grips_of(replace(bar(), colliders=(pusher,))) == ()
    (grip,) = grips_of(replace(bar(), colliders=(replace(pusher, controllers=(1,)),)))
    assert grip.controllers == (0, 2)


def test_a_bonded_bar_sags_as_a_cantilever_of_its_whole_length() -> None:
    modulus, length, height = 2e6, 0.12, 0.02
    bending = 1000.0 * 9.81 * 12 * length**4 / (8 * modulus * height**2)
    shear = 1000.0 * 9.81 * length**2 / (2 * (5 / 6) * modulus / 2)
    assert static_sag(bar(), modulus) == pytest.approx(bending + shear, rel=0.04)
    assert abs(static_sag(bar(BESIDE + np.array([0.116, 0.0, 0.0])), modulus)) < 1e-5  # the tip is held


def test_a_tip_load_adds_its_mass_where_it_hangs_and_its_weight() -> None:
    plain, loaded = bar(), bar(mass_kg=LOAD_KG, where="hung from the tip's upper edge (x = 0, z = 0.02)")
    twin = build_twin(loaded, 600)
    assert twin.body.added_mass is not None and any("0.02 kg" in note for note in twin.body.notes)
    np.testing.assert_allclose(twin.body.added_mass.sum(), LOAD_KG)
    place = (twin.body.added_mass @ twin.lattice.node_coordinates) / LOAD_KG
    np.testing.assert_allclose(place, [0.0, 0.01, 0.02], atol=1e-12)
    modulus = 2e7
    more = static_sag(loaded, modulus) - static_sag(plain, modulus)
    expected = LOAD_KG * 9.81 * 0.12**3 / (3 * modulus * 0.02**4 / 12)
    assert more == pytest.approx(expected, rel=0.05)
    again = Twin.from_arrays(twin.to_arrays())
    np.testing.assert_array_equal(again.body.added_mass, twin.body.added_mass)
    assert Twin.from_arrays(build_twin(plain, 600).to_arrays()).body.added_mass is None


def test_the_place_of_a_load_can_be_points() -> None:
    point = load_of(bar(mass_kg=1, place_m=[0.0, 0.01, 0.02]))
    line = load_of(bar(mass_kg=1, place_m=[[0.0, 0.0, 0.02], [0.0, 0.02, 0.02]]))
    assert point is not None and line is not None
    np.testing.assert_array_equal(point.points, [[0.0, 0.01, 0.02]])
    np.testing.assert_allclose(line.points.mean(axis=0), [0.0, 0.01, 0.02])


@pytest.mark.parametrize(
    ("load", "word"),
    [({"mass_kg": -1}, "positive mass"), ({"mass_kg": 0.1, "where": "at the tip"}, "says no place")],
)
def test_a_load_that_cannot_be_read_is_refused(load: dict[str, Any], word: str) -> None:
    with pytest.raises(SceneUnsupported, match=word):
        load_of(bar(**load))
