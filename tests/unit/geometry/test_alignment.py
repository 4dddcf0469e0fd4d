"""Cell faces lie where grips end, one grip or two, at the end of a body or inside it."""

from __future__ import annotations

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.geometry.alignment import Face, cells_along, faces_along
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip
from physworld.twin.build import build_twin

REACH = 0.5 / np.sqrt(3.0)


def on_a_face(place: float, start: float, cell: float) -> bool:
    steps = (place - start) / cell
    return abs(steps - round(steps)) < 1e-9


def test_without_a_grip_cells_end_with_the_body() -> None:
    assert cells_along(0.2, 1.4, 0.25, [], REACH) == (0.2, pytest.approx(0.24))


@pytest.mark.parametrize("reach", [0.0, REACH])
@pytest.mark.parametrize(("faces", "name"), [
    ([Face(0.3, 1, 0.3)], "held at the low end"),
    ([Face(0.7, -1, 0.3)], "held at the high end"),
    ([Face(0.13, 1, 0.13), Face(0.81, -1, 0.19)], "held at both ends"),
    ([Face(0.3, -1, 0.37), Face(0.67, 1, 0.37)], "held in the middle"),
])  # fmt: skip
def test_every_face_has_a_cell_face_a_reach_inside_the_grip(
    faces: list[Face], name: str, reach: float
) -> None:
    start, cell = cells_along(0.0, 1.0, 0.1, faces, reach)
    assert start <= 1e-12 and start > -cell and 0.06 < cell < 0.16, name
    for face in faces:
        assert on_a_face(face.place - face.way * reach * cell, start, cell), name


def test_two_faces_too_near_for_cells_of_that_size_leave_one_free() -> None:
    faces = [Face(0.3, -1, 0.02), Face(0.32, 1, 0.02)]
    start, cell = cells_along(0.0, 1.0, 0.1, faces, 0.0)
    assert 0.06 < cell < 0.16
    assert [on_a_face(face.place, start, cell) for face in faces].count(True) == 1


def test_a_grip_that_covers_an_axis_or_misses_the_body_has_no_face_there() -> None:
    low, high = np.zeros(3), np.array([1.0, 0.2, 0.2])
    grips = (
        Grip((0,), np.array([-0.1, -0.1, 0.05]), np.array([0.25, 0.3, 0.15])),
        Grip((1,), np.array([2.0, 0.0, 0.0]), np.array([3.0, 0.2, 0.2])),
        Grip((2,)),
    )
    assert faces_along(0, low, high, grips) == [Face(0.25, 1, 0.25)]
    assert faces_along(1, low, high, grips) == []
    assert [(f.place, f.way) for f in faces_along(2, low, high, grips)] == [(0.05, -1), (0.15, 1)]


def test_what_a_grip_in_the_middle_of_a_face_holds_is_its_own_size() -> None:
    low, high = np.array([0.0, -0.05, -0.05]), np.array([0.2, 0.05, 0.05])
    grip = Grip((0,), np.array([0.0, -0.022, -0.022]), np.array([0.03, 0.022, 0.022]))
    controllers = np.array([[0.0, 0.0, 0.0]])
    scene = made_scene([[0.2, 0.0, 0.0]], "beam", controllers, body=box_body(low, high), grips=(grip,))
    twin = build_twin(scene, 1000)
    lattice, held = twin.lattice, twin.held_nodes[0]
    cells = np.isin(lattice.cell_nodes, held).all(axis=1)
    begin, end = lattice.cells[cells].min(axis=0), lattice.cells[cells].max(axis=0) + 1
    clamped_low = lattice.origin + begin * lattice.spacing - REACH * lattice.spacing
    clamped_high = lattice.origin + end * lattice.spacing + REACH * lattice.spacing
    np.testing.assert_allclose(clamped_high, grip.region_max_m, atol=1e-9)
    np.testing.assert_allclose(clamped_low[1:], grip.region_min_m[1:], atol=1e-9)


def test_a_sheet_held_at_two_corners_keeps_its_area_and_has_cell_faces_at_the_grips() -> None:
    grid = np.stack(np.meshgrid(np.linspace(0, 0.24, 9), np.linspace(0, 0.26, 9), indexing="ij"), axis=-1)
    points = np.insert(grid.reshape(-1, 2), 1, 0.0, axis=1)
    grips = tuple(
        Grip((k,), np.array([x, -0.002, 0.2253]), np.array([x + 0.03, 0.002, 0.26]))
        for k, x in enumerate((0.0, 0.21))
    )
    controllers = np.array([[0.015, 0.0, 0.25], [0.225, 0.0, 0.25]])
    scene = made_scene(
        points,
        "sheet",
        controllers,
        body=Body(thickness_m=4e-3),
        grips=grips,
        initial_state=UNDEFORMED_AT_REST,
    )
    twin = build_twin(scene)
    lattice = twin.lattice
    assert float(lattice.particle_measures.sum()) == pytest.approx(0.24 * 0.26, rel=0.01)
    across = int(
        np.argmax(np.abs(np.ptp(lattice.node_coordinates, axis=0) - np.ptp(twin.body.start[:, 0])) < 1e-9)
    )
    for axis, places in ((across, (0.03, 0.21)), (1 - across, (0.2253,))):
        for place in places:
            assert on_a_face(place, lattice.origin[axis], lattice.spacing[axis])
    assert [len(held) for held in twin.held_nodes] == [len(twin.held_nodes[0])] * 2
