"""Points that nobody sees move on with those that are seen."""

from __future__ import annotations

import numpy as np

from physworld.video.hidden import followed

EXACT_M = 1e-9


def turning(frames: int = 10) -> np.ndarray:
    """A rigid cloud that turns by 90 degrees about z and rises."""
    cloud = np.random.default_rng(0).uniform(-0.1, 0.1, (30, 3))
    angles = np.linspace(0.0, np.pi / 2, frames)
    turns = np.array([[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in angles])
    return np.einsum("tij,nj->tni", turns, cloud) + 0.1 * angles[:, None, None] * np.array([0.0, 0.0, 1.0])


def test_hidden_points_of_a_rigid_body_are_where_the_body_is() -> None:
    points = turning()
    visible = np.ones(points.shape[:2], bool)
    visible[4:, :6] = False  # hidden later
    visible[:3, 6:9] = False  # seen later
    visible[5:7, 9:12] = False  # for a moment
    given = np.where(visible[..., None], points, 1e6)
    found = followed(given, visible)
    np.testing.assert_allclose(found, points, atol=EXACT_M)
    np.testing.assert_array_equal(found[visible], points[visible])


def test_points_on_a_line_are_carried_without_a_turn_about_it() -> None:
    line = np.stack([np.linspace(0, 1, 8), np.zeros(8), np.zeros(8)], axis=1)
    points = line + np.arange(4)[:, None, None] * np.array([0.0, 0.1, 0.0])
    visible = np.ones((4, 8), bool)
    visible[2:, 3] = False
    np.testing.assert_allclose(
        followed(np.where(visible[..., None], points, np.nan), visible), points, atol=EXACT_M
    )


def test_without_any_seen_point_everything_stays() -> None:
    points = turning(4)
    visible = np.ones(points.shape[:2], bool)
    visible[2] = False
    np.testing.assert_array_equal(followed(points, visible)[2], points[1])
