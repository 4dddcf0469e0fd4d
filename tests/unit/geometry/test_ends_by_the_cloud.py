"""Ends of ropes and edges of sheets that no tracked point lies on, by the cloud of the first frame."""

from __future__ import annotations

import numpy as np
import pytest
from made_scene import made_scene

from physworld.geometry.reference import reference_body
from physworld.scene import UNDEFORMED_AT_REST, Body

BUDGET, END_M = 500, 2e-3
LENGTH_M, RADIUS_M, HIDDEN_M, INSET_M = 0.6, 0.006, 0.03, 0.02


def test_a_rope_ends_where_its_cloud_ends_and_is_longer_where_a_gripper_covers_it() -> None:
    rng = np.random.default_rng(0)
    along = rng.uniform(HIDDEN_M, LENGTH_M, 900)
    angle = rng.uniform(0.0, np.pi, 900)
    cloud = np.stack([RADIUS_M * np.cos(angle), -RADIUS_M * np.sin(angle), 1.0 - along], axis=1)
    cloud[:3] += [0.0, 0.5, -0.2]  # strays
    points = np.zeros((20, 3))
    points[:, 2] = 1.0 - np.linspace(HIDDEN_M + INSET_M, LENGTH_M - INSET_M, 20)
    hand = [[0.0, 0.0, 1.015], [0.0, 0.0, 0.97]]  # its box reaches past the rope
    body = reference_body(
        made_scene(points, "rope", hand, initial_state=UNDEFORMED_AT_REST, surface_points=cloud,
                   body=Body(length_m=LENGTH_M, radius_m=RADIUS_M)),
        BUDGET,
    )  # fmt: skip
    assert float(body.lattice.particle_measures.sum()) == pytest.approx(LENGTH_M)
    np.testing.assert_allclose(body.points[:, 0], 1.0 - points[:, 2], atol=END_M)


@pytest.mark.parametrize("declared", [True, False])
def test_a_sheet_reaches_to_the_edges_of_its_cloud_and_under_the_bar_that_holds_it(declared: bool) -> None:
    rng = np.random.default_rng(1)
    width, height, hidden = 0.25, 0.27, 0.01
    places = rng.uniform([0.0, 0.0], [width, height - hidden * declared], (6000, 2))
    cloud = np.stack([places[:, 0], np.zeros(6000), places[:, 1]], axis=1)
    x, z = np.meshgrid(np.linspace(INSET_M, width - INSET_M, 9), np.linspace(INSET_M, 0.24, 9))
    points = np.stack([x.ravel(), np.zeros(81), z.ravel()], axis=1)
    bar = [[-0.01, 0.0, height], [width + 0.01, 0.0, height]]
    facts = Body(size_m=np.array([width, 0.002, height]) if declared else None, thickness_m=0.002)
    body = reference_body(
        made_scene(points, "sheet", bar, initial_state=UNDEFORMED_AT_REST, surface_points=cloud, body=facts),
        BUDGET,
    )
    assert float(body.lattice.particle_measures.sum()) == pytest.approx(width * height, rel=0.02)
    np.testing.assert_allclose(body.points, points[:, [0, 2]], atol=END_M)
