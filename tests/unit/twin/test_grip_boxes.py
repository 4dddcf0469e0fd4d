"""A grip that is declared by a box: a sheet is held where it lies in the box, and nowhere beyond."""

from __future__ import annotations

import numpy as np
import pytest
from made_scene import made_scene

from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

WIDTH, THICKNESS, HEIGHT, HELD = 0.22, 0.015, 0.2, 0.022


def slab(depth: tuple[float, float] = (-THICKNESS / 2, THICKNESS / 2), tilt_rad: float = 0.0) -> Scene:
    """A thick sheet in the x-z plane, turned about x; two of its corners are held by boxes of this depth along y."""
    low = np.array([[0.0, depth[0], HEIGHT - HELD], [WIDTH - HELD, depth[0], HEIGHT - HELD]])
    high = np.array([[HELD, depth[1], HEIGHT], [WIDTH, depth[1], HEIGHT]])
    hands = [
        np.array([[x, 0.0, z] for x in (a[0], b[0]) for z in (a[2], b[2])])
        for a, b in zip(low, high, strict=True)
    ]
    points = np.array([[x, 0.0, z] for x in np.linspace(0.0, WIDTH, 9) for z in np.linspace(0.0, HEIGHT, 9)])
    cos, sin = np.cos(tilt_rad), np.sin(tilt_rad)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    grips = tuple(
        Grip(tuple(range(4 * k, 4 * k + 4)), a, b) for k, (a, b) in enumerate(zip(low, high, strict=True))
    )
    return made_scene(
        ((points - [0, 0, HEIGHT]) @ turn.T + [0, 0, HEIGHT]).tolist(), "sheet", np.concatenate(hands), 6,
        body=Body(size_m=np.array([WIDTH, THICKNESS, HEIGHT]), thickness_m=THICKNESS, density_kg_m3=300.0),
        grips=grips, initial_state=UNDEFORMED_AT_REST,
    )  # fmt: skip


def held_cells(twin: Twin) -> np.ndarray:
    """Middles at the start (C, 3) [m] of the cells that the first grip holds."""
    lattice = twin.lattice
    cells = np.isin(lattice.cell_nodes, twin.held_nodes[0]).all(axis=1)
    return twin.particles_start.reshape(*lattice.fill.shape, 3)[cells].mean(axis=1)


@pytest.mark.parametrize("refinement", [0.7, 1.0, 1.2, 1.4, 1.7, 2.0, 2.6])
def test_a_thick_sheet_is_held_up_to_the_end_of_the_box_however_small_its_cells(refinement: float) -> None:
    twin = build_twin(slab(), 1000, refinement=refinement)
    held, spacing = held_cells(twin), twin.lattice.spacing
    assert len(held) and np.all(held[:, 0] < HELD) and np.all(held[:, 2] > HEIGHT - HELD)
    # from the box's end, where a cell begins, to the sheet's edge
    along = held[:, 0].max() - held[:, 0].min()
    assert along == pytest.approx(HELD, abs=1.3 * spacing[0])
    assert held[:, 0].max() == pytest.approx(HELD - 0.5 * spacing[0], abs=1e-6)
    assert held[:, 2].min() == pytest.approx(HEIGHT - HELD + 0.5 * spacing[1], abs=1e-6)


def test_a_box_that_holds_one_side_of_a_sheet_holds_the_sheet() -> None:
    middle = build_twin(slab(), 1000).held_nodes
    side = build_twin(slab((0.4 * THICKNESS, 2 * THICKNESS)), 1000).held_nodes
    for ours, theirs in zip(side, middle, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_sheet_that_is_steep_in_the_box_is_held_where_it_goes_through() -> None:
    twin = build_twin(slab((-0.003, 0.003), tilt_rad=0.7), 1000, refinement=2.0)
    held = held_cells(twin)
    # the depth of the box is met up to half the thickness along the normal, which leans
    assert len(held) and np.abs(held[:, 1]).max() < 0.003 + 0.5 * THICKNESS + twin.lattice.spacing.max()


def test_where_the_box_misses_the_sheet_what_is_nearest_to_its_controllers_is_held() -> None:
    scene = slab((3 * THICKNESS, 4 * THICKNESS))
    twin = build_twin(scene, 1000)
    held = held_cells(twin)
    away = np.linalg.norm(held[:, None] - scene.controllers[0, :4], axis=2).min(axis=1)
    assert len(held) and away.max() < np.linalg.norm(twin.lattice.spacing)
