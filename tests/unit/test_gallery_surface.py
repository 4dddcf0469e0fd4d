"""Surfaces in the gallery's films: they go where the particles go, close where they are stretched, and are lit."""

from __future__ import annotations

import numpy as np
import pytest
from made_scene import made_scene

from physworld.scene import UNDEFORMED_AT_REST, Body
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin
from physworld.video import Renderer, orbit_view
from physworld_services.dashboard.tubes import Tubes
from scripts.gallery_surface import SIDES, DrawnSurface, lit, surface_of_twin

UP = np.array([0.0, 0.0, 1.0])


def sheet() -> Twin:
    plane = np.stack(np.meshgrid(np.linspace(0, 0.3, 7), np.linspace(0, 0.3, 7), indexing="ij"), axis=-1)
    points = np.concatenate([plane.reshape(-1, 2), np.zeros((49, 1))], axis=1)
    body = Body(thickness_m=1e-3)
    return build_twin(
        made_scene(points, "sheet", points[:2], body=body, initial_state=UNDEFORMED_AT_REST), 400
    )


def rope() -> Twin:
    points = np.linspace([0.0, 0.0, 0.0], [0.3, 0.0, 0.0], 5)
    return build_twin(made_scene(points, "rope", points[:1], 12, body=Body(radius_m=0.004)), 200)


def test_a_sheet_goes_where_its_particles_go() -> None:
    twin = sheet()
    start = twin.particles_rest
    drawn = DrawnSurface(surface_of_twin(twin), start, np.array([0.0, 0.0, 2.0]))
    colours = np.tile([0.5, 0.5, 0.5], (len(drawn.middles), 1))
    assert np.abs(drawn.middles[:, 2]).max() < 1e-9
    moved = drawn.at(start + 0.1 * UP, colours)
    np.testing.assert_allclose(moved.means, drawn.middles + 0.1 * UP, atol=1e-9)
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_allclose(drawn.at(start @ turn.T, colours).means, drawn.middles @ turn.T, atol=1e-9)


def test_a_sheet_that_is_stretched_to_twice_its_side_shows_no_gap() -> None:
    twin = sheet()
    stretched = twin.particles_rest * [2.0, 2.0, 1.0]
    corners = np.array([[x, y, 0.0] for x in (0.0, 0.6) for y in (0.0, 0.6)])
    camera = orbit_view(corners, 0.0, 89.0, 160, 120)
    drawn = DrawnSurface(surface_of_twin(twin), twin.particles_rest, camera.centre)
    colours = np.tile([0.2, 0.4, 0.6], (len(drawn.middles), 1))
    coverage = Renderer(camera).render(drawn.at(stretched, colours)).alpha
    pixels = camera.project(np.array([[0.04, 0.04, 0.0], [0.56, 0.56, 0.0]]))[0]
    (left, top), (right, low) = np.round(np.sort(pixels, axis=0)).astype(int)
    assert coverage[top:low, left:right].min() > 0.98


def test_a_rope_is_a_tube_of_its_radius() -> None:
    twin = rope()
    surface = surface_of_twin(twin)
    assert isinstance(surface, Tubes)
    drawn = DrawnSurface(surface, twin.particles_start, np.array([0.0, -1.0, 0.0]))
    from_axis = np.linalg.norm(drawn.middles[:, 1:] - twin.particles_start[0, 1:], axis=1)
    assert from_axis.max() <= surface.radius_m + 1e-9
    assert from_axis.min() >= surface.radius_m * np.cos(np.pi / SIDES) - 1e-9


def test_a_face_towards_the_light_is_brighter_than_one_away_from_it() -> None:
    normals = np.array([[0.0, -1.0, 1.0], [0.0, 0.0, -1.0]]) / [[np.sqrt(2.0)], [1.0]]
    towards, away = lit(np.array([0.5, 0.5, 0.5]), normals, np.array([0.0, -1.0, 0.0]))
    assert (towards > 1.5 * away).all()


def test_a_body_without_cells_is_refused() -> None:
    class Bare:
        particles_rest = np.zeros((20, 3))

        def to_arrays(self) -> dict[str, np.ndarray]:
            return {}

    with pytest.raises(ValueError, match="no cells"):
        surface_of_twin(Bare())  # type: ignore[arg-type]
