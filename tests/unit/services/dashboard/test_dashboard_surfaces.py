"""Surfaces of bodies: closed, outward, near the material, and carried by the vertices around each point."""

from __future__ import annotations

from dataclasses import fields
from itertools import product

import numpy as np
import pytest
from made_scene import made_scene
from published_tiny import tiny_model

from physworld.engine.lattice.lattice import box_lattice
from physworld.scene import UNDEFORMED_AT_REST, Body
from physworld.twin.build import build_twin
from physworld.worldmodel.model.graph import farthest_points
from physworld_services.dashboard.surfaces import (
    CARRIERS,
    NEIGHBOURS,
    Surface,
    body_surface,
    cell_surface,
    sheet_surface,
)

SPACING = np.array([0.02, 0.02, 0.03])


def block(nx: int, ny: int, nz: int) -> np.ndarray:
    return np.array(list(product(range(nx), range(ny), range(nz))))


def volume(points: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_a_block_of_cells_is_closed_and_turned_outward_with_about_its_volume() -> None:
    cells = block(6, 3, 2)
    points, triangles = cell_surface(
        cells, np.ones((len(cells), 8), bool), np.array([1.0, 2.0, 3.0]), SPACING
    )
    edges = np.sort(
        np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1
    )
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert set(counts) == {2}
    declared = float(np.prod(np.array([6, 3, 2]) * SPACING))
    assert volume(points, triangles) == pytest.approx(declared, rel=0.1)
    assert (points.min(axis=0) > np.array([1.0, 2.0, 3.0]) - 0.003).all()
    assert (points.max(axis=0) < np.array([1.12, 2.06, 3.06]) + 0.003).all()


def test_empty_parts_of_a_cell_are_outside() -> None:
    filled = np.ones((1, 8), bool)
    filled[0, :4] = False  # the half at the low end of x
    points, _ = cell_surface(np.zeros((1, 3), int), filled, np.zeros(3), np.ones(3))
    assert points[:, 0].min() > 0.4
    assert points[:, 2].min() < 0.2


def test_the_surface_of_a_twin_lies_around_its_vertices_and_hangs_on_the_nearest() -> None:
    _, twin, model = tiny_model()
    rest = model.spec.rest_vertices
    surface = body_surface(twin.to_arrays(), rest, model.spec.particle_index)
    assert isinstance(surface, Surface)
    assert volume(surface.points, surface.triangles) > 0
    part = twin.to_arrays()["lattice_spacing"] / 2  # a vertex may lie in a part that is hardly filled
    assert (surface.points.min(axis=0) < rest.min(axis=0) + part).all()
    assert (surface.points.max(axis=0) > rest.max(axis=0) - part).all()
    np.testing.assert_allclose(surface.weight.sum(axis=1), 1.0)
    distance = np.linalg.norm(surface.points[:, None] - rest, axis=2)
    carried = np.take_along_axis(distance, surface.index, axis=1)
    np.testing.assert_allclose(carried, np.sort(distance, axis=1)[:, :CARRIERS])
    assert surface.neighbours.shape == (len(rest), NEIGHBOURS)
    assert (surface.neighbours != np.arange(len(rest))[:, None]).all()
    told = surface.document()
    assert len(told["weight"]) == CARRIERS * len(surface.points)
    np.testing.assert_allclose(np.reshape(told["points"], (-1, 3)), surface.points, atol=1e-5)


@pytest.mark.parametrize("mesh", [None, "6x4"])
def test_a_sheet_is_covered_to_its_edges_and_lies_flat_at_rest(mesh: str | None) -> None:
    plane = np.stack(np.meshgrid(np.linspace(0, 0.3, 7), np.linspace(0, 0.2, 5), indexing="ij"), axis=-1)
    points = np.concatenate([plane.reshape(-1, 2), np.zeros((35, 1))], axis=1)
    facts = {} if mesh is None else {"declared": {"body": {"mesh": mesh}}}
    scene = made_scene(
        points, "sheet", points[:2], body=Body(thickness_m=1e-3), initial_state=UNDEFORMED_AT_REST, **facts
    )
    twin = build_twin(scene, 400)
    index = farthest_points(twin.particles_rest, 30)
    surface = body_surface(twin.to_arrays(), twin.particles_rest[index], index)
    assert isinstance(surface, Surface)
    a, b, c = (surface.points[surface.triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert np.linalg.norm(normal, axis=1).sum() / 2 == pytest.approx(0.06, rel=1e-6)
    assert (normal @ normal[0] > 0).all()  # all of them show the same side
    np.testing.assert_allclose(surface.points.min(axis=0), [0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(surface.points.max(axis=0), [0.3, 0.2, 0], atol=1e-9)
    edges = np.sort(surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert set(counts) == {1, 2}
    assert surface.document()["kind"] == "skin"


def test_a_hole_in_a_sheet_stays_open() -> None:
    lattice = box_lattice(np.zeros(2), np.array([0.3, 0.3]), (3, 3))
    filled = np.ones((9, 4), bool)
    filled[4] = False
    arrays = {f"lattice_{field.name}": np.asarray(getattr(lattice, field.name)) for field in fields(lattice)}
    nodes = np.concatenate([lattice.node_coordinates, np.zeros((len(lattice.nodes), 1))], axis=1)
    points, triangles = sheet_surface({**arrays, "body_rest": nodes}, filled)
    middles = points[triangles].mean(axis=1)
    assert not (np.abs(middles[:, :2] - 0.15) < 0.05).all(axis=1).any()
    assert len(triangles) == 2 * 4 * 8


def test_what_is_no_body_of_cells_has_no_surface() -> None:
    rest, index = np.random.default_rng(0).normal(size=(20, 3)), np.arange(20)
    assert body_surface({"rod_nodes": np.zeros((9, 3))}, rest, index) is None
    odd = {"lattice_cells": np.zeros((4, 2), int), "lattice_fill": np.ones((4, 8))}
    assert body_surface(odd, rest, index) is None
