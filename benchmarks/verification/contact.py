"""Verification of self-contact: Coulomb's slope, the sliding block, Eytelwein's belt, weight, momentum, energy, folds.

Bodies are pieces of one lattice that do not hang together, so that a rope can lie across two others of its own.
"""

from __future__ import annotations

import numpy as np

from benchmarks.verification.cases import GRAVITY, Case, hold, rest_nodes
from physworld.engine.lattice.lattice import Lattice, box_lattice, lattice_from_cells
from physworld.engine.problem import Problem
from physworld.engine.terms.contact import GroundContact
from physworld.engine.thin.self_contact import SelfContact
from physworld.engine.total.energy import run_with_ledger
from physworld.engine.total.formulation import Run, TotalLagrangian
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw

G = -float(GRAVITY[2])
DIAMETER = 0.008
ROD = RodLaw(stretching_n=200.0, bending_n_m2=0.05, relaxation_s=1e-4, density_kg_m=0.05)
STRIP = RodLaw(stretching_n=80.0, bending_n_m2=1e-5, density_kg_m=0.05)
BELT = RodLaw(stretching_n=200.0, bending_n_m2=1e-6, relaxation_s=1e-3, density_kg_m=0.02)
CLOTH = SheetLaw(membrane_n_m=300.0, bending_n_m=2e-5, relaxation_s=5e-4, density_kg_m2=0.2)
NOBODY = np.empty(0, dtype=int)
_BETWEEN = 6  # cells of nothing between two pieces


def in_pieces(counts: tuple[tuple[int, ...], ...], dx: float) -> tuple[Lattice, list[np.ndarray]]:
    """A lattice of pieces of so many cells, one after another along its first axis, and the nodes of each."""
    cells, begins, begin = [], [], 0
    for count in counts:
        own = np.stack(np.meshgrid(*[np.arange(c) for c in count], indexing="ij"), axis=-1)
        cells.append(own.reshape(-1, len(count)) + np.eye(len(count), dtype=int)[0] * begin)
        begins.append(begin)
        begin += count[0] + _BETWEEN
    together = np.concatenate(cells)
    dim = together.shape[1]
    lattice = lattice_from_cells(np.zeros(dim), np.full(dim, dx), together, np.ones((len(together), 2**dim)))
    along = lattice.nodes[:, 0]
    pieces = [
        np.flatnonzero((along >= begin - 1) & (along <= begin + count[0]))
        for begin, count in zip(begins, counts, strict=True)
    ]
    return lattice, pieces


def begin_of(lattice: Lattice, piece: np.ndarray) -> float:
    """First coordinate at which a piece begins [m]."""
    return float(lattice.node_coordinates[piece, 0].min() + 0.5 * lattice.spacing[0])


def laid(
    lattice: Lattice, pieces: list[np.ndarray], corners: np.ndarray, axes: list[np.ndarray]
) -> np.ndarray:
    """Nodes (n, 3) of undeformed pieces: each begins at its corner (3,) and lies along its unit axes (d, 3)."""
    nodes = np.zeros((len(lattice.nodes), 3))
    for piece, corner, directions in zip(pieces, corners, axes, strict=True):
        local = lattice.node_coordinates[piece].copy()
        local[:, 0] -= begin_of(lattice, piece)
        nodes[piece] = corner + local @ directions
    return nodes


def crossing(
    cells: float, friction: float, tilt_rad: float, axis: int
) -> tuple[TotalLagrangian, np.ndarray, np.ndarray]:
    """A straight rod across two held ones: solver, nodes, those of the rod. Gravity leans towards ``axis``."""
    count, length = int(cells), 0.275
    dx = length / count
    rails = round(0.2 / dx)
    lattice, pieces = in_pieces(((rails,), (rails,), (count,)), dx)
    corners = np.array([[0, -0.06, 0], [0, 0.067, 0], [0.06, -0.5 * length, DIAMETER]])
    nodes = laid(lattice, pieces, corners, [np.eye(3)[:1], np.eye(3)[:1], np.eye(3)[1:2]])
    gravity = np.array([0.0, 0.0, -G * np.cos(tilt_rad)])
    gravity[axis] = G * np.sin(tilt_rad)
    contact = SelfContact(DIAMETER, friction)
    return TotalLagrangian(Problem(lattice, ROD, nodes, gravity, terms=(contact,))), nodes, pieces[2]


def slope(cells: float, axis: int) -> float:
    """Relative error of the way of a rod that slides on two others down 25 degrees, along them (0) or itself (1)."""
    friction, tilt = 0.364, np.radians(25.0)
    solver, nodes, rod = crossing(cells, friction, tilt, axis)
    rails = np.setdiff1d(np.arange(len(nodes)), rod)
    times = np.linspace(0.0, 0.2, 9)
    moved = solver.run(nodes, 0 * nodes, hold(rails, nodes, 9), times)
    mass = solver.mass[rod]
    way = np.einsum("n,tn->t", mass, moved[:, rod, axis]) / mass.sum()
    acceleration = 2 * np.polyfit(times[2:], way[2:], 2)[0]
    return float(acceleration / (G * (np.sin(tilt) - friction * np.cos(tilt))) - 1)


def separation(cells: float) -> float:
    """How much nearer than a diameter a rod rests on two others that it crosses, over the diameter."""
    solver, nodes, rod = crossing(cells, 0.3, 0.0, 0)
    rails = np.setdiff1d(np.arange(len(nodes)), rod)
    moved = solver.run(nodes, 0 * nodes, hold(rails, nodes, 2), np.array([0.0, 1.0]))
    lattice = solver.problem.lattice
    over = begin_of(lattice, rod) + 0.1375 + np.array([-0.06, 0.067])
    return float((lattice.interpolation(over[:, None]) @ moved[-1])[:, 2].mean() / DIAMETER - 1)


def sliding_sheet(cells: float) -> float:
    """Relative error of the way that one piece of a sheet slides over another, from 0.5 m/s with friction 0.4."""
    thickness, friction, speed, width = 0.002, 0.4, 0.5, 0.08
    dx = width / int(cells)
    long = round(0.28 / dx)
    lattice, (low, top) = in_pieces(((long, round(0.12 / dx)), (round(0.1 / dx), int(cells))), dx)
    sunk = 2 * G * (dx / CLOTH.wave_speed_m_s) ** 2
    corners = np.array([[0, 0, 0], [0.03, 0.013, thickness - sunk]])
    nodes = laid(lattice, [low, top], corners, [np.eye(3)[:2]] * 2)
    velocity = np.zeros_like(nodes)
    velocity[top, 0] = speed
    solver = TotalLagrangian(
        Problem(lattice, CLOTH, nodes, GRAVITY, terms=(SelfContact(thickness, friction),))
    )
    moved = solver.run(nodes, velocity, hold(low, nodes, 2), np.array([0.0, 0.25]))
    mass = solver.mass[top]
    way = np.einsum("n,tn->t", mass, moved[:, top, 0]) / mass.sum()
    return float((way[-1] - way[0]) / (speed**2 / (2 * friction * G)) - 1)


def belt(cells: float) -> float:
    """Relative error of the ratio of tensions in a rope pulled over half a turn of another, friction 0.3."""
    friction, radius, pull = 0.3, 0.05, 0.05
    wrapped, seconds, frames = int(cells), 0.3, 31
    dx = np.pi * radius / wrapped
    leg = int(np.ceil(0.15 / dx))
    lattice, (bar, rope) = in_pieces(((8,), (2 * leg + wrapped,)), dx)
    nodes = laid(
        lattice, [bar, rope], np.array([[0, -4 * dx, 0], [0, 0, 0]]), [np.eye(3)[1:2], np.eye(3)[:1]]
    )
    begin = begin_of(lattice, rope)
    from_top = lattice.node_coordinates[rope, 0] - begin - (leg + 0.5 * wrapped) * dx
    along = 1.01 * from_top + 0.5 * np.pi * radius  # stretched by a hundredth
    angle = np.clip(along / radius, 0, np.pi)
    down = np.minimum(along, 0) - np.maximum(along - np.pi * radius, 0)
    nodes[rope] = np.stack([-radius * np.cos(angle), 0 * angle, radius * np.sin(angle) + down], axis=1)
    times = np.linspace(0, seconds, frames)
    order = rope[np.argsort(lattice.node_coordinates[rope, 0])]
    held = hold(np.concatenate([bar, order[:3], order[-3:]]), nodes, frames)
    for ends, sign in ((slice(len(bar), len(bar) + 3), 1.0), (slice(len(bar) + 3, None), -1.0)):
        held.positions[:, ends, 2] += sign * pull * times[:, None]
        held.velocities[:, ends, 2] = sign * pull
    contact = SelfContact(radius, friction)
    problem = Problem(lattice, BELT, nodes, np.zeros(3), drag_per_s=20.0, terms=(contact,))
    moved = TotalLagrangian(problem).run(nodes, 0 * nodes, held, times)[frames // 2 :]
    places = np.linspace(0.2, 0.7, 21) * leg * dx
    strains = []
    for start in (begin + places, begin + (2 * leg + wrapped) * dx - places):
        slopes = np.stack([lattice.interpolation(start[:, None], (1,)) @ frame for frame in moved])
        strains.append(float(np.mean(np.linalg.norm(slopes, axis=2) - 1)))
    return strains[1] / strains[0] / np.exp(friction * np.pi) - 1


def closing(cells: float, friction: float, damping: float) -> tuple[Problem, np.ndarray, np.ndarray]:
    """A free strip bent to an open ring whose ends fly at each other and past: problem, nodes, velocities."""
    length, arc = 0.6, 5.3
    lattice = box_lattice(np.zeros(1), np.array([length]), (int(cells),))
    along = lattice.node_coordinates[:, 0] / length - 0.5
    nodes = np.zeros((len(along), 3))
    nodes[:, 0], nodes[:, 1] = np.cos(arc * along) * length / arc, np.sin(arc * along) * length / arc
    nodes[:, 2] = 0.005 * along**3
    velocity = np.zeros_like(nodes)
    velocity[:, 1] = -8.0 * along**3
    contact = SelfContact(DIAMETER, friction, damping=damping)
    problem = Problem(lattice, STRIP, rest_nodes(lattice), np.zeros(3), terms=(contact,))
    return problem, nodes, velocity + np.array([0.3, 0.2, 0.1])


def momentum(cells: float) -> float:
    """Change of the linear and angular momentum of a free strip whose ends collide, over what they began with."""
    problem, nodes, velocity = closing(cells, 0.0, 1.0)
    solver, times = TotalLagrangian(problem), np.linspace(0, 0.2, 21)
    run = Run(solver, nodes, velocity, hold(NOBODY, nodes, 21), times)
    mass, momenta = solver.mass[:, None], []
    for frame in range(20):
        place, push = run.advance(frame), mass * run.v.numpy().reshape(-1, 3)
        momenta.append([push.sum(axis=0), np.cross(place, push).sum(axis=0)])
    scales = np.linalg.norm(mass * velocity, axis=1).sum() * np.array([1.0, 0.1])
    return float((np.ptp(momenta, axis=0).max(axis=1) / scales).max())


def elastic(cells: float) -> float:
    """Energy that contact without damping or friction gave to a strip whose ends collided, over what turned over."""
    problem, nodes, velocity = closing(cells, 0.0, 0.0)
    times = np.linspace(0, 0.2, 51)
    _, ledger = run_with_ledger(problem, nodes, velocity, hold(NOBODY, nodes, 51), times)
    return float(ledger.term_work[-1] / ledger.turnover)


def layers(cells: float) -> float:
    """How much nearer than its thickness a sheet that folded over and fell lies on itself, over the thickness."""
    thickness, low, radius = 2e-3, 0.12, 0.02
    lattice = box_lattice(np.zeros(2), np.array([0.3, 0.1]), (int(cells), int(cells) // 3))
    along, nodes = lattice.node_coordinates[:, 0], rest_nodes(lattice)
    angle = np.clip((along - low) / radius, 0, np.pi)
    nodes[:, 0] = (
        np.minimum(along, low) + radius * np.sin(angle) - np.maximum(along - low - np.pi * radius, 0)
    )
    nodes[:, 2] = radius * (1 - np.cos(angle)) + 0.5 * thickness
    terms = (GroundContact(0.0, 0.5, 0.5 * thickness), SelfContact(thickness, 0.3))
    problem = Problem(lattice, CLOTH, rest_nodes(lattice), GRAVITY, drag_per_s=2.0, terms=terms)
    moved = TotalLagrangian(problem).run(nodes, 0 * nodes, hold(NOBODY, nodes, 2), np.array([0.0, 0.6]))
    points = np.stack(np.meshgrid(np.linspace(0.24, 0.295, 12), np.linspace(0.01, 0.09, 9)), axis=-1)
    top = (lattice.interpolation(points.reshape(-1, 2)) @ moved[-1])[:, 2]
    return float((top.min() - 0.5 * thickness) / thickness - 1)


CASES = (
    Case("self_separation", "rod resting across two others: nearer than a diameter", "the diameter", "dx", (11, 22, 44),
         separation, 1e-3, 0.8),
    Case("self_slope_across", "rod sliding on two others down 25°, along them", "g (sin θ − μ cos θ)", "dx",
         (11, 22, 44), lambda n: slope(n, 0), 5e-3, no_order="of the contact, not of the cells"),
    Case("self_slope_along", "rod sliding on two others down 25°, along itself", "g (sin θ − μ cos θ)", "dx",
         (11, 22, 44), lambda n: slope(n, 1), 5e-3, no_order="of the contact, not of the cells"),
    Case("self_sliding", "sheet sliding on itself until it stops", "v² / (2 μ g)", "dx", (4, 8),
         sliding_sheet, 1e-2, no_order="two resolutions"),
    Case("self_belt", "rope pulled over half a turn of another: tensions", "exp(μ π)", "dx", (8, 16, 32),
         belt, 1e-2, no_order="errors of both signs"),
    Case("self_momentum", "ends of a free strip colliding: momentum, linear and angular", "conserved", "dx", (24, 48),
         momentum, 1e-12),
    Case("self_elastic", "the same without damping: energy given", "none", "dx", (24, 48, 96), elastic, 1e-2,
         no_order="each mesh collides otherwise"),
    Case("self_layers", "sheet folded onto itself: nearer than its thickness", "the thickness", "dx", (24, 36), layers,
         2e-2, no_order="two resolutions"),
)  # fmt: skip
