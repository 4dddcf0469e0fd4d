"""A grip that is declared by a radius: what it holds, on every kind of body, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.errors import SceneUnsupported
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

LOW, HIGH = np.zeros(3), np.array([0.2, 0.04, 0.04])
CONTROLLERS = np.array([[0.0, y, z] for y in (0.01, 0.03) for z in (0.01, 0.03)])


def bar(radius_m: float | None, controllers: np.ndarray = CONTROLLERS) -> Scene:
    return made_scene(
        [[0.1, 0.02, 0.04], [0.2, 0.02, 0.04]],
        "beam",
        controllers,
        12,
        body=box_body(LOW, HIGH, density_kg_m3=500.0),
        grips=(Grip(tuple(range(len(controllers))), radius_m=radius_m),),
        initial_state=UNDEFORMED_AT_REST,
    )


def held_particles(twin: Twin) -> np.ndarray:
    """Particles of cells all of whose nodes are held, (P,) bool."""
    lattice = twin.lattice
    cells = np.isin(lattice.cell_nodes, np.concatenate(twin.held_nodes)).all(axis=1)
    return np.repeat(cells, lattice.fill.shape[1])


@pytest.mark.parametrize("radius", [0.03, 0.06])
def test_it_holds_the_material_within_its_radius(radius: float) -> None:
    twin = build_twin(bar(radius), 2000)
    inside = held_particles(twin)
    distance = np.linalg.norm(twin.particles_start[:, None] - CONTROLLERS, axis=2).min(axis=1)
    cell = float(np.linalg.norm(twin.lattice.spacing))
    assert inside.any() and distance[inside].max() < radius + cell
    assert np.all(inside[distance < radius - cell])


def test_a_larger_radius_holds_more_and_none_holds_what_it_did() -> None:
    held = {r: set(np.concatenate(build_twin(bar(r), 2000).held_nodes)) for r in (0.02, 0.05)}
    assert held[0.02] < held[0.05]
    plain = replace(bar(None), grips=(Grip(tuple(range(4))),))
    for ours, theirs in zip(
        build_twin(bar(None), 2000).held_nodes, build_twin(plain, 2000).held_nodes, strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


def test_the_held_material_goes_with_its_controllers() -> None:
    scene = bar(0.05)
    moved = scene.controllers + np.linspace(0, 0.05, len(scene.times))[:, None, None] * [0.0, 0.0, 1.0]
    twin = build_twin(scene, 300)
    particles = twin.simulate(scene.times, moved, scene.times)
    inside = held_particles(twin)
    lifted = particles[-1, inside] - particles[0, inside]
    np.testing.assert_allclose(lifted, np.tile([0.0, 0.0, 0.05], (int(inside.sum()), 1)), atol=1e-9)


def test_two_fingers_of_a_rope_hold_two_places() -> None:
    points = np.stack([np.linspace(0, 0.5, 11), np.zeros(11), np.zeros(11)], axis=1)
    fingers = points[[0, 5]] + [0.0, 0.0, 0.005]
    scene = made_scene(
        points,
        "rope",
        fingers,
        body=replace(box_body(LOW, HIGH), box_min_m=None, box_max_m=None, radius_m=0.005),
        grips=(Grip((0,), radius_m=0.03), Grip((1,), radius_m=0.03)),
        initial_state=UNDEFORMED_AT_REST,
    )
    twin = build_twin(scene)
    at = [twin.body.start[nodes][:, 0].mean() for nodes in twin.held_nodes]
    assert at == pytest.approx([0.0, 0.25], abs=0.03)


def test_a_radius_below_a_cell_holds_the_nearest_cell_and_one_that_reaches_nothing_is_refused() -> None:
    touching = np.array([[0.001, 0.02, 0.02]])
    assert len(np.concatenate(build_twin(bar(1e-3, touching), 300).held_nodes)) > 0
    with pytest.raises(
        SceneUnsupported, match=r"within 0\.01 m of its 4 controllers; the nearest is 0\.\d+ m away"
    ):
        build_twin(bar(0.01, CONTROLLERS - [0.2, 0.0, 0.0]), 300)
