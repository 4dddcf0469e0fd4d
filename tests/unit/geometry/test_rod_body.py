"""Chains of measured ropes and branched cables: order and lengths of the points, branches, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_scene import made_scene

from physworld.errors import SceneUnsupported
from physworld.geometry.rod_body import RADIUS_M, is_discrete, rod_body
from physworld.scene import UNDEFORMED_AT_REST, Body, Scene

LENGTH = 0.8
HANGING = np.stack([0.02 * np.arange(9), np.zeros(9), -0.098 * np.arange(9)], axis=1)


def rope(points: np.ndarray = HANGING, lengths: list[float] | None = None, **facts: Any) -> Scene:
    """Points of a rope that hangs from the origin; ``lengths`` between them are declared."""
    segments = None if lengths is None else np.array(lengths)
    facts.setdefault("body", Body(segment_rest_lengths_m=segments))
    return made_scene(points, "rope", frames=12, **facts)


def cable(edges: list[tuple[int, int]], lengths: list[float], points: np.ndarray) -> Scene:
    """Points of a branched cable whose edges are declared."""
    return made_scene(
        points,
        "branched_rope",
        frames=12,
        body=Body(segment_rest_lengths_m=np.array(lengths)),
        declared={"body": {"topology": {"edges": [list(pair) for pair in edges]}}},
    )


TREE = np.array(
    [[0, 0, 0], [0, 0, -0.2], [0, 0, -0.4], [0, 0, -0.6], [0.1, 0, -0.4], [0.2, 0, -0.4], [-0.1, 0, -0.2]]
)
EDGES = [(0, 1), (1, 2), (2, 3), (2, 4), (4, 5), (1, 6)]
LENGTHS = [0.2, 0.2, 0.2, 0.1, 0.1, 0.1]


def test_points_of_a_rope_are_nodes_in_the_order_from_its_grip() -> None:
    body = rod_body(rope(HANGING[::-1]), 1.0)
    nodes = body.lattice.interpolation(body.points) @ body.start
    assert nodes == pytest.approx(HANGING[::-1], abs=1e-12)
    away = body.lattice.interpolation(body.points) @ body.lattice.distances
    assert np.all(np.diff(away) < 0.0)


def test_edges_are_about_a_thirtieth_of_the_rope_and_shorter_where_refined() -> None:
    coarse, fine = rod_body(rope(), 1.0).lattice, rod_body(rope(), 2.0).lattice
    assert len(coarse.cells) == pytest.approx(30, abs=4)
    assert len(fine.cells) == pytest.approx(60, abs=8)
    assert coarse.lengths.sum() == pytest.approx(fine.lengths.sum(), rel=1e-12)


def test_lengths_without_a_declaration_are_the_largest_that_are_seen() -> None:
    scene = rope()
    points = scene.points.copy()
    points[3, 5:] += [0.0, 0.0, -0.01]  # in one training frame the fifth gap is 1 cm wider
    body = rod_body(replace(scene, points=points), 1.0)
    gap = np.linalg.norm(HANGING[1] - HANGING[0])
    wider = np.linalg.norm(HANGING[5] - HANGING[4] + [0.0, 0.0, -0.01])
    assert body.lattice.lengths.sum() == pytest.approx(7.0 * gap + wider, rel=1e-9)


def test_a_declared_length_within_three_percent_of_what_is_seen_counts() -> None:
    seen = 8.0 * np.linalg.norm(HANGING[1])
    for declared, taken in ((1.02 * seen, 1.02 * seen), (1.2 * seen, seen), (0.9 * seen, seen)):
        body = rod_body(rope(body=Body(length_m=declared)), 1.0)
        assert body.lattice.lengths.sum() == pytest.approx(taken, rel=1e-9)


def test_declared_segments_count_whatever_is_seen() -> None:
    body = rod_body(rope(lengths=[0.11] * 8), 1.0)
    assert body.lattice.lengths.sum() == pytest.approx(0.88)
    assert body.lattice.distances[body.lattice.parent[-1] + 1] == pytest.approx(0.88)


def test_two_points_make_a_rope_that_can_bend() -> None:
    body = rod_body(rope(HANGING[[0, 8]], lengths=[LENGTH]), 1.0)
    assert len(body.lattice.cells) >= 3
    short = rod_body(replace(rope(HANGING[:2], lengths=[0.1]), points=rope(HANGING[:2]).points), 1 / 30)
    assert len(short.lattice.cells) >= 3


def test_a_branched_cable_keeps_its_branches_and_their_lengths() -> None:
    body = rod_body(cable(EDGES, LENGTHS, TREE), 1.0)
    lattice = body.lattice
    assert len(lattice.branches) == 2
    assert lattice.lengths.sum() == pytest.approx(sum(LENGTHS))
    away = lattice.interpolation(body.points) @ lattice.distances
    assert away == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.5, 0.6, 0.3], abs=1e-9)
    assert lattice.interpolation(body.points) @ body.start == pytest.approx(TREE, abs=1e-12)


def test_a_branched_cable_does_not_ask_how_its_edges_are_listed() -> None:
    plain = rod_body(cable(EDGES, LENGTHS, TREE), 1.0)
    order = [4, 2, 5, 0, 3, 1]
    turned = [EDGES[k][::-1] for k in order]
    other = rod_body(cable(turned, [LENGTHS[k] for k in order], TREE), 1.0)
    assert len(other.lattice.parent) == len(plain.lattice.parent)
    for body in (plain, other):
        assert body.lattice.interpolation(body.points) @ body.start == pytest.approx(TREE, abs=1e-12)


def test_a_material_coordinate_names_one_place_of_a_branched_cable() -> None:
    lattice = rod_body(cable(EDGES, LENGTHS, TREE), 1.0).lattice
    coordinates = lattice.node_coordinates[:, 0]
    assert np.all(np.diff(coordinates) > 0.0)
    weights = lattice.interpolation(lattice.particle_coordinates)
    edges = np.repeat(np.arange(len(lattice.cells)), 2)
    assert np.all(
        np.sort(weights.indices.reshape(-1, 2), axis=1) == np.sort(lattice.cell_nodes[edges], axis=1)
    )


@pytest.mark.parametrize(
    ("edges", "lengths", "message"),
    [
        (EDGES[:-1], LENGTHS[:-1], "5 segment rest lengths and 5 edges for 7 tracked points"),
        (EDGES, LENGTHS[:-1], "5 segment rest lengths and 6 edges for 7 tracked points"),
        ([*EDGES[:-1], (1, 9)], LENGTHS, r"edge \(1, 9\) of 0.1 m is none between 7 tracked points"),
        ([*EDGES[:-1], (6, 6)], LENGTHS, r"edge \(6, 6\) of 0.1 m is none"),
        (EDGES, [*LENGTHS[:-1], 0.0], r"edge \(1, 6\) of 0.0 m is none"),
        ([(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6)], LENGTHS, "twice|hang on no edge"),
        ([(0, 1), (1, 2), (2, 3), (2, 4), (4, 1), (5, 6)], LENGTHS, "reached twice: a cable without rings"),
    ],
)  # fmt: skip
def test_what_is_no_tree_is_refused_with_numbers(edges: Any, lengths: Any, message: str) -> None:
    with pytest.raises(SceneUnsupported, match=message):
        rod_body(cable(edges, lengths, TREE), 1.0)


def test_a_ring_is_refused() -> None:
    points = HANGING[:4]
    ring = cable([(0, 1), (1, 2), (2, 3)], [0.1] * 3, points)
    ring = replace(ring, declared={"body": {"topology": {"edges": [[0, 1], [1, 2], [2, 0]]}}})
    with pytest.raises(SceneUnsupported, match="ring"):
        rod_body(ring, 1.0)


def test_points_that_nothing_orders_are_refused() -> None:
    with pytest.raises(SceneUnsupported, match="nothing orders the 9 points of a rope"):
        rod_body(rope(controllers=np.zeros((12, 0, 3))), 1.0)
    with pytest.raises(SceneUnsupported, match="1 tracked points show no rod"):
        rod_body(rope(HANGING[:1]), 1.0)


def test_few_points_at_rest_start_as_they_hang_and_moving_ones_as_seen() -> None:
    few = rope(HANGING[[0, 4, 8]], lengths=[0.4, 0.4])
    assert rod_body(few, 1.0).settles
    assert not rod_body(rope(), 1.0).settles
    moving = replace(few, points=few.points + 0.5 * few.times[:, None, None] * np.array([1.0, 0.0, 0.0]))
    body = rod_body(moving, 1.0)
    assert not body.settles
    assert body.start_velocity == pytest.approx(np.tile([0.5, 0.0, 0.0], (len(body.start), 1)), abs=1e-9)


def test_a_radius_that_is_not_declared_is_said() -> None:
    body = rod_body(rope(), 1.0)
    assert body.thickness_m == RADIUS_M
    assert any("radius not declared" in note for note in body.notes)
    declared = rod_body(rope(body=Body(radius_m=0.01)), 1.0)
    assert declared.thickness_m == 0.01
    assert not any("radius" in note for note in declared.notes)


def test_ropes_as_measured_are_discrete_rods_unless_they_touch_themselves() -> None:
    assert is_discrete(rope())
    assert not is_discrete(rope(initial_state=UNDEFORMED_AT_REST))
    assert not is_discrete(rope(declared={"body": {"self_contact": True}}))
    assert is_discrete(replace(cable(EDGES, LENGTHS, TREE), initial_state=UNDEFORMED_AT_REST))
    assert not is_discrete(replace(rope(), kind="cloth"))
