"""Where a body touches: on its faces, drawn in where cells are filled in part."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.engine.lattice.lattice import box_lattice, lattice_from_cells
from physworld.engine.terms.contact import contact_points
from physworld.geometry.filling import filled_body

pytestmark = pytest.mark.slow


def test_the_points_of_a_full_box_cover_its_faces() -> None:
    low, size = np.array([0.1, 0.0, -0.2]), np.array([0.3, 0.2, 0.1])
    points, areas, groups = contact_points(box_lattice(low, size, (3, 4, 2)))
    on_face = np.isclose(points, low) | np.isclose(points, low + size)
    assert (on_face.sum(axis=1) == 1).all()
    assert areas.sum() == pytest.approx(2 * (0.3 * 0.2 + 0.2 * 0.1 + 0.1 * 0.3))
    assert [areas[groups == g].sum() for g in range(6)] == pytest.approx([0.02, 0.02, 0.03, 0.03, 0.06, 0.06])


def test_a_cell_filled_to_a_height_touches_at_that_height() -> None:
    fill = np.ones((1, 2, 2, 2))
    fill[..., 1] = 0.3  # the upper eighths: material up to 0.65 of the cell
    lattice = lattice_from_cells(
        np.zeros(3), np.full(3, 0.1), np.zeros((1, 3), dtype=int), fill.reshape(1, 8)
    )
    points, _, groups = contact_points(lattice)
    assert points[groups == 5][:, 2] == pytest.approx(0.065)
    assert points[groups == 4][:, 2] == pytest.approx(0.0)


def test_the_points_of_a_ball_lie_near_its_surface() -> None:
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-1, 1, size=(5000, 3))
    body = filled_body(cloud[np.linalg.norm(cloud, axis=1) < 1])
    count, low = 9, -1.125
    spacing = np.full(3, 0.25)
    cells = np.stack(np.meshgrid(*[np.arange(count)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    local = (np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) / 8
    inside = body.contains((low + (cells[:, None] + local) * spacing).reshape(-1, 3)).reshape(
        -1, 2, 4, 2, 4, 2, 4
    )
    fill = inside.mean(axis=(2, 4, 6)).reshape(-1, 8)
    kept = fill.max(axis=1) > 0.25
    lattice = lattice_from_cells(np.full(3, low), spacing, cells[kept], fill[kept])
    points, areas, groups = contact_points(lattice)
    away = np.linalg.norm(points, axis=1) - 1
    assert np.sqrt(np.average(away**2, weights=areas)) < 0.3 * 0.25
    down = points[groups == 4]
    assert down[:, 2].min() == pytest.approx(-1.0, abs=0.06)
