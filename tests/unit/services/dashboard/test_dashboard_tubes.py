"""Ropes and cables as tubes: along the whole rod, through its vertices, round where the rod is round, one a branch."""

from __future__ import annotations

import numpy as np
import pytest
from made_scene import made_scene

from physworld.scene import UNDEFORMED_AT_REST, Body, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin
from physworld.worldmodel.model.graph import farthest_points
from physworld_services.dashboard.surfaces import body_surface
from physworld_services.dashboard.tubes import MOST_PLACES, THINNEST, Tubes

LENGTH_M, RADIUS_M, VERTICES = 0.3, 0.004, 20
EDGES = [[0, 1], [1, 2], [2, 3], [2, 4], [4, 5], [1, 6]]
TREE = np.array(
    [[0, 0, 0], [0, 0, -0.2], [0, 0, -0.4], [0, 0, -0.6], [0.1, 0, -0.4], [0.2, 0, -0.4], [-0.1, 0, -0.2]]
)


def rope(**facts: object) -> Scene:
    points = np.linspace([0.0, 0.0, 0.0], [LENGTH_M, 0.0, 0.0], 5)
    fields = {"body": Body(radius_m=RADIUS_M), **facts}
    return made_scene(points, "rope", points[:1], 12, **fields)


def cable() -> Scene:
    body = Body(segment_rest_lengths_m=np.array([0.2, 0.2, 0.2, 0.1, 0.1, 0.1]), radius_m=RADIUS_M)
    return made_scene(
        TREE, "branched_rope", frames=12, body=body, declared={"body": {"topology": {"edges": EDGES}}}
    )


SCENES = {"splines": lambda: rope(initial_state=UNDEFORMED_AT_REST), "discrete": rope, "branches": cable}


def tubes_of(scene: Scene, vertices: int = VERTICES) -> tuple[Twin, np.ndarray, Tubes]:
    """The twin, the particles that are its vertices, and its tubes."""
    twin = build_twin(scene, 200)
    index = farthest_points(twin.particles_rest, vertices)
    found = body_surface(twin.to_arrays(), twin.particles_rest[index], index)
    assert isinstance(found, Tubes)
    return twin, index, found


def drawn(tubes: Tubes, vertices: np.ndarray) -> list[np.ndarray]:
    """The centre lines that the browser draws over the vertices (n, 3)."""
    places = np.einsum("mk,mkd->md", tubes.weight, vertices[tubes.index])
    return np.split(places, np.cumsum(tubes.lines)[:-1])


@pytest.mark.parametrize("name", SCENES)
def test_tubes_run_through_the_vertices_over_all_of_the_rod(name: str) -> None:
    twin, index, tubes = tubes_of(SCENES[name]())
    lines = drawn(tubes, twin.particles_start[index])
    assert len(lines) == (3 if name == "branches" else 1)
    np.testing.assert_allclose(tubes.weight.sum(axis=1), 1.0)
    places = np.concatenate(lines)
    step = max(np.linalg.norm(np.diff(line, axis=0), axis=1).max() for line in lines)
    distance = np.linalg.norm(twin.particles_start[:, None] - places, axis=2).min(axis=1)
    assert distance.max() < 0.6 * step  # straight pieces: every particle lies on a line
    length = sum(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in lines)
    assert length == pytest.approx(twin.lattice.particle_measures.sum(), rel=0.02)


def test_a_bent_rod_is_drawn_round_between_its_vertices() -> None:
    twin, index, tubes = tubes_of(rope())
    radius_m = 0.08
    angle = twin.lattice.particle_coordinates[index, 0] / radius_m
    circle = radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    (line,) = drawn(tubes, circle)
    inner = line[12:-12]  # the ends go straight on
    away = np.abs(np.linalg.norm(inner, axis=1) - radius_m)
    apart = np.diff(np.sort(angle)).max()
    assert away.max() < 0.1 * radius_m * (1 - np.cos(apart / 2))  # a tenth of what chords would leave


def test_a_branch_begins_at_the_cable() -> None:
    twin, index, tubes = tubes_of(cable())
    vertices = twin.particles_start[index]
    trunk, *branches = drawn(tubes, vertices)
    starts = sorted(tuple(np.round(branch[0], 4) + 0.0) for branch in branches)
    assert starts == sorted(tuple(TREE[k]) for k in (1, 2))
    ends = sorted(tuple(np.round(line[-1], 6) + 0.0) for line in (trunk, *branches))
    assert ends == sorted(tuple(TREE[k]) for k in (3, 5, 6))


def test_a_tube_is_as_thick_as_the_rope_but_to_be_seen() -> None:
    assert tubes_of(rope())[2].radius_m == RADIUS_M
    thin = tubes_of(rope(body=Body(radius_m=1e-5)))[2]
    assert thin.radius_m == pytest.approx(THINNEST * LENGTH_M, rel=0.01)


def test_few_and_many_vertices() -> None:
    twin, index, tubes = tubes_of(rope(), vertices=2)
    assert tubes.index.shape == (tubes.lines[0], 2)
    (line,) = drawn(tubes, twin.particles_start[index])
    np.testing.assert_allclose(line[[0, -1]], [[0, 0, 0], [LENGTH_M, 0, 0]], atol=1e-3)
    assert body_surface(twin.to_arrays(), twin.particles_rest[:1], np.array([0])) is None
    every = np.arange(len(twin.particles_rest))
    whole = body_surface(twin.to_arrays(), twin.particles_rest, every)
    assert isinstance(whole, Tubes) and whole.lines[0] <= MOST_PLACES
    told = whole.document()
    assert (told["kind"], len(told["index"])) == ("tube", told["carriers"] * whole.lines[0])
