"""Grips that hold a part of a section, against finite elements of scikit-fem with the gripped region prescribed.

At rest (how far a body sags) and in motion (its first bending frequency). Elements with nodes prescribed in a region
converge with the power 1.3 of their size to a body that is held there, so frequencies are extrapolated.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import skfem
from scipy.optimize import curve_fit
from scipy.sparse.linalg import eigsh
from skfem.helpers import ddot, dot, sym_grad, trace

from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.soft_grips import (
    AS_HELD,
    gram_matrix,
    gripped_points,
    holds_a_part,
    soften,
    touched_nodes,
)
from physworld.engine.total.formulation import TotalLagrangian
from physworld.materials.neo_hookean import NeoHookean

pytestmark = pytest.mark.slow

SIZE = np.array([0.12, 0.06, 0.06])
GRIP_LOW, GRIP_HIGH = np.array([0.0, 0.015, 0.015]), np.array([0.03, 0.045, 0.045])
LAW = NeoHookean(1e5, 0.3, density_kg_m3=1000.0)
GRAVITY = np.array([0.0, 0.0, -1.0])
TIP = np.array([[0.12, 0.03, 0.03]])


WHOLE, THIN = np.stack([GRIP_LOW, GRIP_HIGH]), np.stack([GRIP_LOW, [0.015, 0.045, 0.045]])
BOXES = {"whole": WHOLE, "thin": THIN}
ORDER = 1.3  # seen with 4, 8 and 16 elements across


def basis_of(axes: list[np.ndarray]) -> skfem.Basis:
    """Quadratic hexahedra between these faces."""
    return skfem.Basis(skfem.MeshHex.init_tensor(*axes), skfem.ElementVector(skfem.ElementHex2()), intorder=4)


@skfem.BilinearForm
def stiffness(u, v, w):
    mu, lam = LAW.lame
    return 2 * mu * ddot(sym_grad(u), sym_grad(v)) + lam * trace(sym_grad(u)) * trace(sym_grad(v))


@skfem.BilinearForm
def inertia(u, v, w):
    return LAW.density_kg_m3 * dot(u, v)


@skfem.LinearForm
def weight(v, w):
    return LAW.density_kg_m3 * GRAVITY[2] * v[2]


def held_by(basis: skfem.Basis, box: np.ndarray) -> np.ndarray:
    """Which degrees of freedom lie in a box (2, 3) [m]."""
    low, high = box[:, :, None] + np.array([-1e-9, 1e-9])[:, None, None]
    return np.all((basis.doflocs >= low) & (basis.doflocs <= high), axis=0)


@cache
def sag_by_finite_elements(cells: int) -> float:
    """Deflection of the far face's middle [m] by quadratic hexahedra, ``cells`` of them across the body."""
    counts = (2 * cells, cells, cells)
    basis = basis_of([np.linspace(0, side, count + 1) for side, count in zip(SIZE, counts, strict=True)])
    held = np.flatnonzero(held_by(basis, WHOLE))
    u = skfem.solve(*skfem.condense(stiffness.assemble(basis), weight.assemble(basis), D=held))
    return float(-(basis.probes(TIP.T) @ u).reshape(3, -1)[2, 0])


@cache
def frequency_by_finite_elements(held: str) -> float:
    """First bending frequency [Hz] of the body that is held in a box, extrapolated from 4 and 8 elements across."""
    coarse, fine = (_bending_of_a_quarter(BOXES[held], cells) for cells in (4, 8))
    return fine - (coarse - fine) / (2**ORDER - 1)


def _bending_of_a_quarter(box: np.ndarray, cells: int) -> float:
    """Up and down, of a quarter of the section: symmetric about one middle plane, antisymmetric about the other."""
    half = SIZE[1] / 2
    across = np.linspace(0, half, cells // 2 + 1)
    basis = basis_of([np.linspace(0, SIZE[0], 2 * cells + 1), across, across])
    part = np.zeros(basis.N, dtype=int)  # 0: along, 1: across, 2: up
    for numbers in (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs):
        part[numbers] = np.arange(len(numbers))[:, None] % 3
    _, y, z = basis.doflocs
    fixed = held_by(basis, box) | ((y > half - 1e-9) & (part == 1)) | ((z > half - 1e-9) & (part != 2))
    free = np.flatnonzero(~fixed)
    matrices = [form.assemble(basis).tocsr()[free][:, free].tocsc() for form in (stiffness, inertia)]
    return float(np.sqrt(eigsh(matrices[0], 1, matrices[1], sigma=0.0)[0][0]) / (2 * np.pi))


def tip(
    lattice: Lattice, softness: float, box: np.ndarray, times: np.ndarray, drag_per_s: float
) -> np.ndarray:
    """How far the middle of the far face is below its start [m], (T,), by the engine."""
    start = lattice.node_coordinates
    shares = gripped_points(lattice, start, box)
    nodes = touched_nodes(lattice, shares)
    paths = np.repeat(start[nodes][None], len(times), axis=0)
    held = HeldNodes(nodes, paths, np.zeros_like(paths))
    problem = Problem(lattice, LAW, start, GRAVITY, drag_per_s=drag_per_s)
    problem, held = soften(problem, held, softness, [box])
    found = TotalLagrangian(problem).run(start, np.zeros_like(start), held, times)
    row = lattice.interpolation(TIP)
    return np.array([(row @ (start - now))[0, 2] for now in found])


def sag(cells: int, softness: float) -> float:
    """Deflection once a strong drag has brought the body to rest [m]."""
    lattice = box_lattice(np.zeros(3), SIZE, (2 * cells, cells, cells))
    return float(tip(lattice, softness, WHOLE, np.linspace(0.0, 1.5, 16), 30.0)[-1])


def frequency(counts: tuple[int, int, int], softness: float, box: np.ndarray) -> float:
    """Of the swing after gravity has set in [Hz]."""
    times = np.linspace(0.0, 0.9, 181)
    drop = tip(box_lattice(np.zeros(3), SIZE, counts), softness, box, times, 0.0)

    def swing(t: np.ndarray, size: float, hz: float, decay: float) -> np.ndarray:
        return size * (1.0 - np.exp(-decay * t) * np.cos(2 * np.pi * hz * t))

    guesses = [curve_fit(swing, times, drop, (drop.mean(), hz, 0.1))[0] for hz in (5.0, 6.0, 7.0, 8.0, 10.0)]
    return float(min(guesses, key=lambda one: np.sum((swing(times, *one) - drop) ** 2))[1])


@pytest.mark.parametrize("held", BOXES)
@pytest.mark.parametrize("counts", [(8, 4, 4), (12, 6, 6), (16, 8, 8), (16, 4, 4)])
def test_softly_held_bodies_ring_as_finite_elements_do_on_cells_of_any_size_and_shape(
    counts: tuple[int, int, int], held: str
) -> None:
    ringing = frequency(counts, AS_HELD, BOXES[held])
    assert ringing == pytest.approx(frequency_by_finite_elements(held), rel=0.03)


def test_bodies_whose_nodes_are_prescribed_ring_too_fast() -> None:
    assert frequency((16, 8, 8), 0.0, THIN) > 1.15 * frequency_by_finite_elements("thin")


@pytest.mark.parametrize("cells", [4, 8])
def test_softly_held_sections_sag_as_finite_elements_do_where_prescribed_nodes_are_too_stiff(
    cells: int,
) -> None:
    peer = sag_by_finite_elements(4)  # itself 3 % short of its limit
    assert sag(cells, 0.0) < 0.8 * peer
    assert sag(cells, 1 / 6) == pytest.approx(peer, rel=0.03)


def test_the_softer_the_grip_the_more_it_gives() -> None:
    found = [sag(4, softness) for softness in (0.0, 1 / 300, 1 / 40, 1 / 10)]
    assert found == sorted(found)
    assert found[1] == pytest.approx(found[0], rel=0.01)


def test_softness_zero_or_a_grip_without_material_changes_nothing() -> None:
    _, problem, held = _gripped_box()
    assert soften(problem, held, 0.0, [WHOLE]) == (problem, held)
    assert soften(problem, held, 0.1, []) == (problem, held)
    assert soften(problem, held, 0.1, [WHOLE + 1.0]) == (problem, held)


def test_the_gram_matrix_of_all_splines_sums_up_to_the_gripped_volume() -> None:
    lattice, _, held = _gripped_box()
    box = WHOLE + np.array([0.0, 0.001, -0.003])  # across cells
    gram = gram_matrix(lattice, [box], np.arange(len(lattice.nodes)))
    assert gram.sum() == pytest.approx(np.prod(box[1] - box[0]), rel=1e-12)
    assert np.allclose(gram, gram.T)
    shares = gripped_points(lattice, lattice.node_coordinates, WHOLE)
    assert np.array_equal(touched_nodes(lattice, shares), held.nodes)


def test_what_a_soft_grip_holds_follows_its_motion_at_any_frame_rate() -> None:
    lattice, problem, held = _gripped_box()
    shift = np.array([0.05, 0.02, 0.0]) * np.sin(np.pi * TIMES / TIMES[-1])[:, None] ** 2
    paths = held.positions + shift[:, None]
    moved = HeldNodes(held.nodes, paths, np.gradient(paths, TIMES, axis=0, edge_order=2))
    soft, firm = soften(problem, moved, 1 / 40, [WHOLE])
    start = lattice.node_coordinates
    found = TotalLagrangian(soft).run(start, np.zeros_like(start), firm, TIMES)
    middle = lattice.interpolation(np.array([[0.5 * GRIP_HIGH[0], 0.03, 0.03]]))
    gap = np.stack([(middle @ (now - start))[0] for now in found]) - shift
    assert np.abs(gap).max() < 2e-4  # of 5 cm


TIMES = np.concatenate([np.linspace(0.0, 0.2, 5), np.linspace(0.23, 0.5, 4)])  # uneven


def _gripped_box() -> tuple[Lattice, Problem, HeldNodes]:
    lattice = box_lattice(np.zeros(3), SIZE, (8, 4, 4))
    middle = lattice.origin + (lattice.cells + 0.5) * lattice.spacing
    inside = np.all((middle > GRIP_LOW) & (middle < GRIP_HIGH), axis=1)
    nodes = np.unique(lattice.cell_nodes[inside])
    paths = np.repeat(lattice.node_coordinates[nodes][None], len(TIMES), axis=0)
    return (
        lattice,
        Problem(lattice, LAW, lattice.node_coordinates, np.zeros(3)),
        HeldNodes(nodes, paths, np.zeros_like(paths)),
    )


def test_a_clamp_across_a_whole_section_holds_no_part() -> None:
    lattice = box_lattice(
        np.array([-0.001, 0.0, 0.0]), SIZE, (8, 4, 4)
    )  # cells that begin before the body does
    start = lattice.node_coordinates
    across = np.array([[0.0, 0.0, 0.0], [0.03, 0.06, 0.06]])
    assert not holds_a_part(lattice, start, across)
    assert not holds_a_part(lattice, start, across + 1.0)  # nothing is there
    assert holds_a_part(lattice, start, np.stack([GRIP_LOW, GRIP_HIGH]))
    assert holds_a_part(lattice, start, np.array([[0.0, 0.0, 0.03], [0.03, 0.06, 0.06]]))
