"""Verification of ropes, rods and sheets: catenary, elastica, hanging chain, beam and plate theory."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from benchmarks.verification.cases import (
    CLAMP_REACH,
    GRAVITY,
    Case,
    clamped_lattice,
    gripped,
    path,
    rest_nodes,
    ringing,
    run,
)
from benchmarks.verification.solids import CLAMPED_FREE, bending_mode
from physworld.engine.lattice.lattice import Lattice, box_lattice, lattice_from_cells
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw

LENGTH = 0.3
ROD = RodLaw(stretching_n=200.0, bending_n_m2=2e-2, density_kg_m=0.05)
PLATE = SheetLaw(membrane_n_m=300.0, bending_n_m=1.5e-2, poissons_ratio=0.3, density_kg_m2=0.5)
CHAIN_ROOT = 2.404825557695773  # first zero of J0
CLAMPED_PLATE = 35.9866  # omega a^2 sqrt(m / D) of a square plate clamped all round (Leissa 1973)
CLAMPED_PLATE_SAG = 0.00126532  # D w / q a^4 at its middle (Timoshenko, Woinowsky-Krieger 1959)


def rod_frequency(cells: float) -> float:
    """Relative error of the first bending frequency of a clamped rod against Euler and Bernoulli."""
    lattice = clamped_lattice(LENGTH, (), (int(cells),))
    rest = rest_nodes(lattice)
    exact = CLAMPED_FREE**2 * np.sqrt(ROD.bending_n_m2 / ROD.density_kg_m) / LENGTH**2
    velocity = np.zeros_like(rest)
    velocity[:, 2] = 0.01 * bending_mode(np.clip(rest[:, 0] / LENGTH, 0, None))
    times = np.linspace(0.0, 4 * 2 * np.pi / exact, 160)
    nodes = run(lattice, ROD, times, gripped(lattice), gravity=np.zeros(3), velocity=velocity)
    return ringing(times, path(lattice, nodes, (LENGTH,))[:, 2], exact)[1] / exact - 1


def heavy_elastica(bending: float, weight: float, length: float) -> tuple[float, float]:
    """Tip (x, z) [m] of a clamped inextensible rod under its own ``weight`` a length: B th'' = w (L - s) cos th."""
    mesh = np.linspace(0.0, length, 200)
    guess = np.stack([-np.pi / 3 * mesh / length, np.full_like(mesh, -np.pi / 3 / length)])
    found = solve_bvp(
        lambda s, y: np.stack([y[1], weight * (length - s) * np.cos(y[0]) / bending]),
        lambda a, b: np.array([a[0], b[1]]),
        mesh,
        guess,
        tol=1e-8,
        max_nodes=20000,
    )
    fine = np.linspace(0.0, length, 4001)
    angle = found.sol(fine)[0]
    return float(np.trapezoid(np.cos(angle), fine)), float(np.trapezoid(np.sin(angle), fine))


def elastica(cells: float) -> float:
    """Distance of a sagging rod's tip from the heavy elastica, over the sag; the rod hangs by about 60 degrees."""
    law = RodLaw(stretching_n=2000.0, bending_n_m2=2e-3, density_kg_m=0.1)
    exact = heavy_elastica(law.bending_n_m2, law.density_kg_m * 9.81, LENGTH)
    lattice = clamped_lattice(LENGTH, (), (int(cells),))
    times = np.linspace(0.0, 3.0, 11)
    nodes = run(lattice, law, times, gripped(lattice), drag_per_s=12.0)
    tip = path(lattice, nodes, (LENGTH,))[-1]
    return float(np.hypot(tip[0] - exact[0], tip[2] - exact[1]) / abs(exact[1]))


def catenary(cells: float) -> float:
    """Relative error of the sag of a slack rope between two pins against the catenary."""
    span, length = 0.7, 1.0
    law = RodLaw(stretching_n=2000.0, bending_n_m2=1e-6, relaxation_s=2e-4, density_kg_m=0.05)
    lattice = box_lattice(np.zeros(1), np.array([length]), (int(cells),))
    start = rest_nodes(lattice)
    half = brentq(lambda a: np.sin(a) / a - span / length, 0.1, 3.0)  # first shape: a circular arc
    radius, angle = length / (2 * half), (lattice.node_coordinates[:, 0] / length - 0.5) * 2 * half
    start[:, 0], start[:, 2] = radius * np.sin(angle), radius * (np.cos(half) - np.cos(angle))
    held = np.array([1, len(start) - 2])
    times = np.linspace(0.0, 5.0, 11)
    nodes = run(lattice, law, times, held, start=start, drag_per_s=4.0)
    first, last = nodes[-1, held[0]], nodes[-1, held[1]]
    between = lattice.node_coordinates[held[1], 0] - lattice.node_coordinates[held[0], 0]
    scale = brentq(lambda a: 2 * a * np.sinh((last[0] - first[0]) / (2 * a)) - between, 0.02, 10.0)
    sag = scale * (np.cosh((last[0] - first[0]) / (2 * scale)) - 1)
    return float((first[2] - path(lattice, nodes, (length / 2,))[-1, 2]) / sag - 1)


def chain(cells: float, reach: float = CLAMP_REACH) -> float:
    """Relative error of the swing of a hanging rope without bending stiffness, (j01 / 2) sqrt(g / L)."""
    length = 0.5
    law = RodLaw(stretching_n=1000.0, bending_n_m2=1e-7, density_kg_m=0.05)
    lattice = clamped_lattice(length, (), (int(cells),), reach)
    s = rest_nodes(lattice)[:, 0]
    start = np.zeros_like(rest_nodes(lattice))
    stretch = law.density_kg_m * 9.81 * (length * s - s**2 / 2) / law.stretching_n
    start[:, 2] = -(s + np.where(s > 0, stretch, 0.0))
    exact = 0.5 * CHAIN_ROOT * np.sqrt(9.81 / length)
    velocity = np.zeros_like(start)
    velocity[:, 0] = 5e-3 * np.clip(s / length, 0, None) ** 1.3
    times = np.linspace(0.0, 8 * 2 * np.pi / exact, 400)
    nodes = run(lattice, law, times, gripped(lattice), start=start, velocity=velocity)
    tip = path(lattice, nodes, (length,))[:, 0]
    return ringing(times, tip, exact)[1] / exact - 1


def _clamped_plate(cells: int, side: float) -> tuple[Lattice, np.ndarray]:
    """A square sheet with one more, gripped layer of cells all round."""
    dx = side / cells
    grid = np.stack(np.meshgrid(*[np.arange(cells + 2)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    lattice = lattice_from_cells(np.full(2, -dx), np.full(2, dx), grid, np.ones((len(grid), 4)))
    rim = np.any((grid == 0) | (grid == cells + 1), axis=1)
    return lattice, np.unique(lattice.cell_nodes[rim])


def plate_sag(cells: float) -> float:
    """Relative error of the sag of a clamped square plate under a weak gravity."""
    side = 0.3
    lattice, held = _clamped_plate(int(cells), side)
    gravity = GRAVITY * 2e-3
    load = PLATE.density_kg_m2 * 9.81 * 2e-3
    exact = CLAMPED_PLATE_SAG * load * side**4 / PLATE.bending_n_m
    frequency = CLAMPED_PLATE / side**2 * np.sqrt(PLATE.bending_n_m / PLATE.density_kg_m2)
    times = np.linspace(0.0, 14 / frequency, 11)
    nodes = run(lattice, PLATE, times, held, gravity=gravity, drag_per_s=2 * frequency)
    return float(-path(lattice, nodes, (side / 2, side / 2))[-1, 2] / exact - 1)


def plate_frequency(cells: float) -> float:
    """Relative error of the first frequency of a clamped square plate."""
    side = 0.3
    lattice, held = _clamped_plate(int(cells), side)
    rest = rest_nodes(lattice)
    exact = CLAMPED_PLATE / side**2 * np.sqrt(PLATE.bending_n_m / PLATE.density_kg_m2)
    velocity = np.zeros_like(rest)
    shape = [np.sin(np.pi * np.clip(rest[:, k] / side, 0, 1)) ** 2 for k in range(2)]
    velocity[:, 2] = 1e-3 * shape[0] * shape[1]
    times = np.linspace(0.0, 6 * 2 * np.pi / exact, 200)
    nodes = run(lattice, PLATE, times, held, gravity=np.zeros(3), velocity=velocity)
    middle = path(lattice, nodes, (side / 2, side / 2))[:, 2]
    return ringing(times, middle, exact)[1] / exact - 1


CASES = (
    Case("rod_frequency", "clamped rod, bending frequency", "Euler-Bernoulli", "dx", (10, 20, 40), rod_frequency,
         2e-3, 1.7),
    Case("elastica", "clamped rod sagging by 60°: tip", "heavy elastica", "dx", (8, 16, 32), elastica, 3e-3, 1.5),
    Case("catenary", "slack rope between pins: sag", "catenary", "dx", (15, 30, 60), catenary, 5e-3, 1.5),
    Case("chain", "hanging rope, swing", "(j₀₁/2)√(g/L)", "dx", (16, 32, 64), chain, 2e-3,
         no_order="errors of both signs"),
    Case("chain_old_clamp", "hanging rope, swing, cell face on the grip", "(j₀₁/2)√(g/L)", "dx", (16, 32, 64),
         lambda n: chain(n, 0.0), 5e-3, 0.7),
    Case("plate_sag", "square sheet clamped all round, sag", "Kirchhoff plate", "dx", (6, 12, 24), plate_sag,
         1e-2, 1.7),
    Case("plate_frequency", "square sheet clamped all round, frequency", "Kirchhoff plate", "dx", (6, 12, 24),
         plate_frequency, 5e-3, 1.7),
)  # fmt: skip
