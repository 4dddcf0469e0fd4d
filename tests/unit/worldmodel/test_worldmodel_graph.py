"""Vertices and edges."""

from __future__ import annotations

import numpy as np
import pytest
from held_bar import SMALL, graph, lattice

from physworld.worldmodel.errors import GraphInvalid
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.graph import (
    COARSE,
    GRIP,
    NEAR,
    build_graph,
    choose_control_vertices,
    farthest_points,
)


def _edges(spec) -> set[tuple[int, int, int]]:
    receivers, slots = np.nonzero(spec.neighbours < spec.vertex_count)
    senders, kinds = spec.neighbours[receivers, slots], spec.edge_kind[receivers, slots]
    return {(int(r), int(s), int(k)) for r, s, k in zip(receivers, senders, kinds, strict=True)}


def test_farthest_points_keep_their_distance() -> None:
    points = np.random.default_rng(0).uniform(size=(500, 3))
    chosen = farthest_points(points, 40)
    gaps = np.linalg.norm(points[chosen][:, None] - points[chosen][None], axis=2) + 9.0 * np.eye(40)
    uncovered = np.linalg.norm(points[:, None] - points[chosen][None], axis=2).min(axis=1).max()
    assert gaps.min() >= uncovered


def test_every_edge_has_its_opposite_of_the_same_kind() -> None:
    edges = _edges(graph())
    assert edges == {(s, r, k) for r, s, k in edges}
    assert all(r != s for r, s, _ in edges)


def test_kinds_say_what_an_edge_joins() -> None:
    spec = graph()
    n = spec.object_count
    for receiver, sender, kind in _edges(spec):
        assert (kind == GRIP) == (receiver >= n or sender >= n)
    kinds = {kind for _, _, kind in _edges(spec)}
    assert kinds == {NEAR, COARSE, GRIP}


def test_near_edges_stay_within_the_radius_and_every_vertex_hears_its_nearest() -> None:
    spec = graph()
    length = np.linalg.norm(spec.rest_relative, axis=2)
    near = (spec.neighbours < spec.vertex_count) & (spec.edge_kind == NEAR)
    assert length[near].max() <= spec.edge_radius_m
    assert near[: spec.object_count].sum(axis=1).min() >= SMALL.neighbours
    assert spec.edge_radius_m == pytest.approx(SMALL.edge_radius_spacings * spec.vertex_spacing_m)


def test_relative_rest_positions_are_those_of_sender_and_receiver() -> None:
    spec = graph()
    for receiver in range(spec.object_count):
        for slot, sender in enumerate(spec.neighbours[receiver]):
            if sender < spec.object_count:
                expected = spec.rest_vertices[sender] - spec.rest_vertices[receiver]
                assert spec.rest_relative[receiver, slot] == pytest.approx(expected)


def test_without_coarse_vertices_the_graph_is_the_local_one_of_the_paper() -> None:
    spec = graph(WorldModelConfig(vertices=30, neighbours=5, coarse_links=0, coarse_vertices=0))
    assert {kind for _, _, kind in _edges(spec)} == {NEAR, GRIP}


def test_many_controllers_are_thinned_by_grip_and_few_are_kept() -> None:
    many = np.random.default_rng(1).uniform(size=(30, 3))
    groups = (np.arange(15), np.arange(15, 30))
    chosen = choose_control_vertices(many, groups, SMALL)
    assert len(chosen) == 12
    assert (chosen < 15).sum() == 6
    assert choose_control_vertices(many[:5], (), SMALL).tolist() == [0, 1, 2, 3, 4]


def test_a_single_particle_is_no_body() -> None:
    one = lattice()[:1]
    with pytest.raises(GraphInvalid, match=r"\(1, 3\)"):
        build_graph(one, one, one, dt_s=0.03, config=SMALL)
