"""Laws of the spline lattice in one, two and three dimensions, with holes and partly filled cells."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from physworld.engine.lattice.bspline import gauss_points, local_offsets, tensor_weights
from physworld.engine.lattice.lattice import Lattice, box_lattice, lattice_from_cells

ROUND_OFF = 1e-12
ORIGIN = np.array([0.3, -0.2, 0.7])
SIZE = np.array([0.6, 0.5, 0.4])
COUNTS = (4, 3, 5)
SHAPES = (1, 2, 3)


def box(dim: int) -> Lattice:
    return box_lattice(ORIGIN[:dim], SIZE[:dim], COUNTS[:dim])


def inside(dim: int, count: int = 200) -> np.ndarray:
    return ORIGIN[:dim] + np.random.default_rng(dim).uniform(size=(count, dim)) * SIZE[:dim]


def unit(dim: int, axis: int) -> tuple[int, ...]:
    return tuple(int(a == axis) for a in range(dim))


@pytest.mark.parametrize("dim", SHAPES)
def test_weights_are_a_partition_of_unity_and_nowhere_negative(dim: int) -> None:
    xi = np.random.default_rng(0).uniform(size=(50, dim))
    weights = tensor_weights(xi, (0,) * dim)
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=ROUND_OFF)
    for axis in range(dim):
        np.testing.assert_allclose(tensor_weights(xi, unit(dim, axis)).sum(axis=1), 0.0, atol=ROUND_OFF)


@pytest.mark.parametrize("dim", SHAPES)
@pytest.mark.parametrize("order", [1, 2])
def test_weights_are_the_derivatives_that_they_claim_to_be(dim: int, order: int) -> None:
    xi = np.random.default_rng(1).uniform(0.1, 0.9, size=(20, dim))
    step = 1e-5
    for axis in range(dim):
        lower = tuple((order - 1) * k for k in unit(dim, axis))
        ahead, behind = (tensor_weights(xi + s * step * np.array(unit(dim, axis)), lower) for s in (1, -1))
        derived = tensor_weights(xi, tuple(order * k for k in unit(dim, axis)))
        np.testing.assert_allclose(derived, (ahead - behind) / (2 * step), atol=1e-9)


def test_the_basis_and_its_slope_are_continuous_across_cells() -> None:
    lattice = box_lattice(np.zeros(1), np.ones(1), (5,))
    nodes = np.random.default_rng(2).normal(size=len(lattice.nodes))
    faces = np.arange(1, 5)[:, None] / 5
    for orders, scale in (((0,), 1.0), ((1,), 5.0)):
        left = lattice.interpolation(faces - 1e-9, orders) @ nodes
        right = lattice.interpolation(faces + 1e-9, orders) @ nodes
        np.testing.assert_allclose(left, right, atol=1e-6 * scale)


@pytest.mark.parametrize("dim", SHAPES)
def test_linear_fields_are_exact_inside_and_far_outside(dim: int) -> None:
    lattice = box(dim)
    rng = np.random.default_rng(3)
    slope, base = rng.normal(size=(dim, 3)), rng.normal(size=3)
    nodes = lattice.node_coordinates @ slope + base
    outside = ORIGIN[:dim] + rng.uniform(-2.0, 3.0, size=(100, dim))
    for points in (inside(dim), outside):
        np.testing.assert_allclose(lattice.interpolation(points) @ nodes, points @ slope + base, atol=1e-11)


@pytest.mark.parametrize("dim", SHAPES)
def test_slopes_and_second_derivatives_are_in_metres(dim: int) -> None:
    lattice = box(dim)
    x = lattice.node_coordinates
    spacing = lattice.spacing
    points = inside(dim)
    for i, j in product(range(dim), repeat=2):
        orders = tuple(a + b for a, b in zip(unit(dim, i), unit(dim, j), strict=True))
        # a node holds a quadratic's blossom: x_i x_j off the diagonal, x_i^2 - h^2/4 on it
        nodes = x[:, i] * x[:, j] - (spacing[i] ** 2 / 4 if i == j else 0.0)
        np.testing.assert_allclose(
            lattice.interpolation(points) @ nodes, points[:, i] * points[:, j], atol=1e-11
        )
        wanted = 2.0 if i == j else 1.0
        np.testing.assert_allclose(lattice.interpolation(points, orders) @ nodes, wanted, atol=1e-9)
        slope = lattice.interpolation(points, unit(dim, i)) @ nodes
        np.testing.assert_allclose(slope, (2.0 if i == j else 1.0) * points[:, j], atol=1e-10)


@pytest.mark.parametrize("dim", SHAPES)
def test_outside_a_curved_field_is_continued_by_the_slope_at_the_face(dim: int) -> None:
    lattice = box(dim)
    nodes = np.random.default_rng(4).normal(size=len(lattice.nodes))
    face = ORIGIN[:dim] + SIZE[:dim] * np.array([1.0, 0.4, 0.4])[:dim]
    out = np.zeros(dim)
    out[0] = 0.17
    value = (lattice.interpolation(face) @ nodes)[0]
    slope = (lattice.interpolation(face, unit(dim, 0)) @ nodes)[0]
    assert (lattice.interpolation(face + out) @ nodes)[0] == pytest.approx(value + 0.17 * slope, rel=1e-9)
    np.testing.assert_allclose(lattice.outside(np.stack([face, face + out])), [0.0, 0.17], atol=ROUND_OFF)


@pytest.mark.parametrize("dim", SHAPES)
def test_particles_stand_for_the_whole_volume_and_its_moments(dim: int) -> None:
    lattice = box(dim)
    measure, x = lattice.particle_measures, lattice.particle_coordinates
    volume = np.prod(SIZE[:dim])
    assert measure.sum() == pytest.approx(volume, rel=ROUND_OFF)
    centre = ORIGIN[:dim] + SIZE[:dim] / 2
    np.testing.assert_allclose(measure @ x, volume * centre, atol=ROUND_OFF)
    second = np.einsum("p,pi,pj->ij", measure, x - centre, x - centre)  # a bending profile is exact
    np.testing.assert_allclose(second, np.diag(volume * SIZE[:dim] ** 2 / 12), atol=ROUND_OFF)


def test_a_share_of_material_is_the_share_of_the_volume() -> None:
    full = box(3)
    fill = full.fill.copy()
    fill[full.cells[:, 0] == 3, 4:] = 0.0  # the outer half of the last layer of cells
    fill[full.cells[:, 1] == 0] *= 0.25
    lattice = lattice_from_cells(full.origin, full.spacing, full.cells, fill)
    assert lattice.particle_measures.sum() == pytest.approx(
        np.prod(SIZE) * (7 / 8) * (1 - 0.75 / 3), rel=1e-12
    )


def test_a_hole_has_neither_cells_nor_nodes_of_its_own() -> None:
    ring = np.array([c for c in product(range(7), repeat=2) if not all(1 <= k <= 5 for k in c)])
    lattice = lattice_from_cells(np.zeros(2), np.full(2, 0.1), ring, np.ones((len(ring), 4)))
    assert lattice.particle_measures.sum() == pytest.approx(0.01 * 24)
    assert not (lattice.nodes == [3, 3]).all(axis=1).any()
    centre = np.array([[0.35, 0.35]])
    assert lattice.outside(centre)[0] == pytest.approx(0.25)
    np.testing.assert_allclose(
        lattice.interpolation(centre) @ lattice.node_coordinates, centre, atol=ROUND_OFF
    )


@pytest.mark.parametrize("dim", SHAPES)
def test_the_table_of_a_cell_is_the_interpolation_at_its_particles(dim: int) -> None:
    lattice = box(dim)
    for orders in {(0,) * dim, unit(dim, 0), tuple(2 * k for k in unit(dim, dim - 1))}:
        table = lattice.table(orders) / np.prod(lattice.spacing ** np.array(orders))
        nodes = np.random.default_rng(5).normal(size=len(lattice.nodes))
        by_cell = (nodes[lattice.cell_nodes] @ table).reshape(-1)
        whole = lattice.interpolation(lattice.particle_coordinates, orders) @ nodes
        np.testing.assert_allclose(by_cell, whole, atol=1e-10)


@pytest.mark.parametrize("dim", SHAPES)
def test_a_cell_lists_its_nodes_and_particles_with_the_last_axis_fastest(dim: int) -> None:
    lattice = box(dim)
    np.testing.assert_array_equal(
        lattice.nodes[lattice.cell_nodes], lattice.cells[:, None] + local_offsets(dim)[None]
    )
    first = lattice.origin + (lattice.cells[0] + gauss_points(dim)) * lattice.spacing
    np.testing.assert_allclose(lattice.particle_coordinates[: 2**dim], first)


def test_a_lattice_without_material_or_with_too_much_is_refused() -> None:
    with pytest.raises(ValueError, match="got 0"):
        lattice_from_cells(np.zeros(2), np.ones(2), np.empty((0, 2)), np.empty((0, 4)))
    with pytest.raises(ValueError, match=r"up to 1\.5"):
        lattice_from_cells(np.zeros(1), np.ones(1), np.array([[0]]), np.array([[0.5, 1.5]]))
    with pytest.raises(ValueError, match=r"must be \(1, 2\)"):
        lattice_from_cells(np.zeros(1), np.ones(1), np.array([[0]]), np.array([[0.5, 0.5, 0.5]]))


@pytest.mark.parametrize("dim", SHAPES)
def test_second_differences_vanish_for_affine_fields_and_no_others_that_particles_miss(dim: int) -> None:
    thin = box_lattice(ORIGIN[:dim], SIZE[:dim], (3, 1, 1)[:dim])
    bends = thin.second_differences()
    np.testing.assert_allclose(bends @ thin.node_coordinates, 0.0, atol=ROUND_OFF)
    rows = thin.interpolation(thin.particle_coordinates)
    both = np.concatenate([rows.toarray(), bends.toarray()])
    assert np.linalg.matrix_rank(both) == len(thin.nodes)
    if dim > 1:
        assert np.linalg.matrix_rank(rows.toarray()) < len(thin.nodes)
