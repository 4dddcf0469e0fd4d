"""Signed distances against closed forms and against the nearest of many points on the surface."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from physworld.errors import SceneUnsupported
from physworld.shapes import sdf
from physworld.shapes.surface_mesh import SurfaceMesh, merged

pytestmark = pytest.mark.slow

CLOUD = np.random.default_rng(0).uniform(-0.3, 0.3, size=(2000, 3))
SHAPES = {
    "sphere": (sdf.sphere(0.1), trimesh.creation.icosphere(subdivisions=5, radius=0.1)),
    "box": (sdf.box((0.1, 0.2, 0.3)), trimesh.creation.box((0.1, 0.2, 0.3))),
    "capsule": (sdf.capsule(0.08, 0.2), trimesh.creation.capsule(0.2, 0.08, count=(96, 96))),
    "cylinder": (sdf.cylinder(0.1, 0.2), trimesh.creation.cylinder(0.1, 0.2, sections=256)),
}
FACET_M = 3e-4  # how far a faceted mesh lies inside of the round shape


@pytest.mark.parametrize("name", SHAPES)
def test_a_primitive_is_as_far_as_the_nearest_point_of_its_surface(name: str) -> None:
    shape, mesh = SHAPES[name]
    nearest, gap, _ = trimesh.proximity.closest_point_naive(mesh, CLOUD[:60])
    assert np.abs(shape.distance(CLOUD[:60])) == pytest.approx(gap, abs=FACET_M)
    foot = CLOUD[:60] - shape.distance(CLOUD[:60])[:, None] * shape.normal(CLOUD[:60])
    assert np.linalg.norm(foot - nearest, axis=1).max() < 25 * FACET_M


@pytest.mark.parametrize("name", SHAPES)
def test_a_sampled_mesh_agrees_with_the_closed_form(name: str) -> None:
    shape, mesh = SHAPES[name]
    sampled = sdf.mesh_shape(SurfaceMesh(mesh.vertices, mesh.faces))
    foot = CLOUD - shape.distance(CLOUD)[:, None] * shape.normal(CLOUD)
    near = foot + sampled.spacing_m * np.random.default_rng(1).uniform(-1, 1, size=foot.shape)
    error = sampled.distance(near) - shape.distance(near)
    assert np.sqrt(np.mean(error**2)) < 0.05 * sampled.spacing_m + FACET_M
    assert sampled.inner_m == pytest.approx(shape.inner_m, abs=sampled.spacing_m)
    assert sampled.reach_m == pytest.approx(shape.reach_m, rel=0.01)


@pytest.mark.parametrize("name", SHAPES)
def test_normals_are_gradients_of_the_distance(name: str) -> None:
    shape, step = SHAPES[name][0], 1e-6
    numbers = np.stack(
        [
            (shape.distance(CLOUD + step * e) - shape.distance(CLOUD - step * e)) / (2 * step)
            for e in np.eye(3)
        ],
        axis=1,
    )
    smooth = np.abs(np.linalg.norm(numbers, axis=1) - 1) < 1e-6  # not on a medial surface
    assert smooth.mean() > 0.99
    assert shape.normal(CLOUD)[smooth] == pytest.approx(numbers[smooth], abs=1e-4)


def test_a_half_space_ends_at_its_plane() -> None:
    assert sdf.half_space().distance(CLOUD) == pytest.approx(CLOUD[:, 2])


def test_a_mesh_with_a_hole_is_refused_with_the_number_of_its_open_edges() -> None:
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    with pytest.raises(SceneUnsupported, match=r"not watertight: 3 of 33 edges"):
        sdf.mesh_shape(SurfaceMesh(mesh.vertices, mesh.faces[1:]))


def test_a_mesh_too_thin_for_its_grid_is_refused() -> None:
    leaf = trimesh.creation.box((0.2, 0.2, 0.001))
    with pytest.raises(SceneUnsupported, match=r"thick, less than two of the 64 grid cells"):
        sdf.mesh_shape(SurfaceMesh(leaf.vertices, leaf.faces))


def test_merging_closes_a_triangle_soup_and_turns_it_outwards_once() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    soup = mesh.vertices[mesh.faces].reshape(-1, 3)
    inside_out = np.arange(len(soup)).reshape(-1, 3)[:, ::-1]
    once = merged(soup, inside_out)
    assert once.fault() is None and once.volume_m3 == pytest.approx(mesh.volume)
    again = merged(once.vertices, once.faces)
    assert np.array_equal(again.vertices, once.vertices) and np.array_equal(again.faces, once.faces)
