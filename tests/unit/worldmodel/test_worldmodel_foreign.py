"""A twin put where another recording of its object starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_scene import tiny_scene
from two_handed_bar import opened, two_handed_bar

from benchmarks.peers.flex_sheet import FlexSheet, record
from physworld.effects.registry import effect
from physworld.engine.thin.triangles import Mesh, mesh_of
from physworld.errors import SceneUnsupported
from physworld.scene import Body, Ground, Scene
from physworld.twin.build import build_twin
from physworld.worldmodel.foreign import predict, start_mismatch, twin_on
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.scene_view import view_scene

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SHIFT = np.array([0.3, -0.2, 0.0])


def moved(scene: Scene) -> Scene:
    """The same recording a quarter turn farther on, of a body that declares no box any more."""
    corners = np.stack([scene.body.box_min_m, scene.body.box_max_m])
    fill = np.stack(np.meshgrid(*corners.T, indexing="ij"), axis=-1).reshape(-1, 3)
    return replace(
        scene,
        points=scene.points @ TURN.T + SHIFT,
        controllers=scene.controllers @ TURN.T + SHIFT,
        body=Body(density_kg_m3=300.0),
        surface_points=fill @ TURN.T + SHIFT,
        grips=(),
    )


def test_the_same_body_takes_its_new_start_and_keeps_what_was_learned() -> None:
    home = tiny_scene()
    lifted = replace(home, points=home.points + 1e-3, name="again")
    twin = build_twin(home, 60).with_parameters(youngs_modulus_pa=3e4, air_drag_per_s=0.4)
    twin = twin.with_effect(effect("air_drag_quadratic", coefficient_per_m=0.2))
    placed = twin_on(lifted, home, twin, 60)
    assert placed.parameters == twin.parameters
    assert placed.effects == twin.effects
    np.testing.assert_array_equal(placed.particles_rest, twin.particles_rest)


def test_fields_soft_grips_and_the_transfer_go_with_the_twin() -> None:
    home = tiny_scene()
    twin = build_twin(home, 60)
    field = np.full((len(twin.particles_rest), 2), 0.3)
    twin = replace(twin, properties=field, grip_softness=0.5, transfer="asflip", self_friction=0.2)
    placed = twin_on(replace(home, points=home.points + 1e-3), home, twin, 60)
    np.testing.assert_array_equal(placed.properties, field)
    assert (placed.grip_softness, placed.transfer, placed.self_friction) == (0.5, "asflip", 0.2)


def test_a_body_that_looks_different_is_moved_as_a_whole() -> None:
    home = tiny_scene()
    twin = build_twin(home, 60).with_parameters(youngs_modulus_pa=3e4)
    elsewhere = moved(home)
    placed = twin_on(elsewhere, home, twin, 60)
    np.testing.assert_allclose(placed.particles_start, twin.particles_start @ TURN.T + SHIFT, atol=1e-9)
    np.testing.assert_allclose(placed.controllers_start, elsewhere.controllers[0])
    assert start_mismatch(elsewhere, placed) == pytest.approx(start_mismatch(home, twin), abs=1e-6)
    times = home.times[:6]
    particles = [
        t.simulate(scene.times, scene.controllers, times) for t, scene in ((twin, home), (placed, elsewhere))
    ]
    np.testing.assert_allclose(particles[1], particles[0] @ TURN.T + SHIFT, atol=1e-6)


@pytest.mark.parametrize("softness", [0.0, 0.5])
def test_a_moved_twin_stands_on_the_recordings_ground_and_is_held_as_at_home(softness: float) -> None:
    home = replace(tiny_scene(), ground=Ground(-0.3))
    twin = replace(build_twin(home, 60), grip_softness=softness)
    elsewhere = replace(moved(home), ground=Ground(-0.2))
    placed = twin_on(elsewhere, home, twin, 60)
    assert placed.ground_height_m == -0.2
    times = home.times[:6]
    particles = [
        t.simulate(scene.times, scene.controllers, times) for t, scene in ((twin, home), (placed, elsewhere))
    ]
    np.testing.assert_allclose(particles[1], particles[0] @ TURN.T + SHIFT, atol=1e-6)


def test_heights_count_from_the_recordings_ground() -> None:
    home = replace(tiny_scene(), ground=Ground(-0.02))
    twin = build_twin(home, 60)
    config = WorldModelConfig(hidden=16, message_passing_steps=1, vertices=20)
    view = view_scene(home, twin, config)
    network = WorldModel(config, view.spec)
    torch.manual_seed(0)
    torch.nn.init.normal_(network.skip.weight, std=1e-3)  # heights are among what it reads
    phi = np.zeros((view.spec.object_count, 2))
    model = view.published(network, phi, phi)
    up = np.array([0.0, 0.0, 0.3])
    body = replace(home.body, box_min_m=home.body.box_min_m + up, box_max_m=home.body.box_max_m + up)
    region = home.grips[0]
    grip = replace(region, region_min_m=region.region_min_m + up, region_max_m=region.region_max_m + up)
    lifted = replace(
        home,
        points=home.points + up,
        controllers=home.controllers + up,
        body=body,
        grips=(grip,),
        ground=Ground(0.28),
    )
    tracks = [predict(model, r, twin_on(r, home, twin, 60)).tracks for r in (home, lifted)]
    np.testing.assert_allclose(tracks[1], tracks[0] + up, atol=1e-5)


def test_a_mesh_stays_a_mesh_where_a_plate_would_have_the_same_cells() -> None:
    sheet = record(FlexSheet(size_m=(0.24, 0.24), cells=(24, 24), frames=3, noise_sigma_m=0.0))
    corners = [[x, 0.0, z] for x in (-0.12, 0.12) for z in (0.36, 0.6)]
    points = sheet.points.copy()
    points[0, :4] = corners
    home = replace(sheet, points=points, visible=np.ones_like(sheet.visible))
    twin, plate = build_twin(home, mesh=Mesh((24, 24))), build_twin(home)
    np.testing.assert_allclose(plate.lattice.spacing, twin.lattice.spacing)
    assert mesh_of(twin_on(home, home, twin, 2000).lattice) == Mesh((24, 24))


def test_other_controllers_or_points_are_refused_with_their_numbers() -> None:
    home = tiny_scene()
    twin = build_twin(home, 60)
    with pytest.raises(SceneUnsupported, match="3 controllers, the model was trained with 4"):
        twin_on(replace(home, controllers=home.controllers[:, :3], grips=()), home, twin, 60)
    fewer = moved(home)
    fewer = replace(fewer, points=fewer.points[:, :3], visible=fewer.visible[:, :3])
    with pytest.raises(SceneUnsupported, match="shows 3 points"):
        twin_on(fewer, home, twin, 60)


def test_where_grips_let_go_a_version_needs_models_for_those_that_hold() -> None:
    home = two_handed_bar()
    twin = build_twin(home, 60)
    config = WorldModelConfig(hidden=16, message_passing_steps=1, vertices=20)
    both, left = (view_scene(home, twin, config, grips) for grips in (None, (0,)))
    phi = np.zeros((both.spec.object_count, 2))
    model, other = (view.published(WorldModel(config, view.spec), phi, phi) for view in (both, left))
    caught = replace(home, grips=(home.grips[0], opened(home.grips[1], (0.2, 0.3))))
    placed = twin_on(caught, home, twin, 60)
    assert placed.openings[1] is not None
    with pytest.raises(SceneUnsupported, match=r"grips let go .* \[0\] hold .* world models of \[0, 1\]"):
        predict(model, caught, placed)
    alone, together = (
        predict(one, scene, on).tracks
        for one, scene, on in (
            (model, home, twin),
            (replace(model, others=(other,)), caught, placed),
        )
    )
    assert np.isfinite(together).all() and together.shape == alone.shape
    elsewhere = replace(moved(home), controllers=home.controllers)
    with pytest.raises(SceneUnsupported, match="looks different"):
        twin_on(replace(elsewhere, grips=caught.grips), home, twin, 60)


def test_ticks_count_from_the_first_frame_not_from_the_first_control_sample() -> None:
    home = tiny_scene()
    clock = np.arange(0.02, home.times[-1] + 0.02, 0.01)
    lift = 0.1 * (clock - 0.02)[:, None, None] * np.array([0.0, 0.0, 1.0])
    late = replace(home, control_times=clock, control_points=home.controllers[:1] + lift)
    twin = build_twin(late, 60)
    view = view_scene(late, twin, WorldModelConfig(hidden=16, message_passing_steps=1, vertices=20))
    expected = np.maximum(view.times - 0.02, 0.0) * 0.1
    np.testing.assert_allclose(view.controllers[:, 0, 2] - home.controllers[0, 0, 2], expected, atol=1e-9)
    particles = twin.simulate(*late.control_track(), late.times)
    np.testing.assert_allclose(view.vertices, particles[:, view.spec.particle_index], atol=1e-9)
