"""Small bodies for the physics tests: clamped at their lower end along the first axis."""

from __future__ import annotations

import numpy as np

from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.term import Term
from physworld.engine.total.formulation import TotalLagrangian
from physworld.materials.laws import Law
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw
from physworld.materials.solid import SolidLaw

GRAVITY = np.array([0.0, 0.0, -9.81])


def clamped_lattice(free_length: float, sections: tuple[float, ...], counts: tuple[int, ...]) -> Lattice:
    """A box whose first axis runs from -dx (one gripped cell) to ``free_length``; ``counts`` are of the free part."""
    dx = free_length / counts[0]
    return box_lattice(
        np.array([-dx, *(0.0 for _ in sections)]),
        np.array([free_length + dx, *sections]),
        (counts[0] + 1, *counts[1:]),
    )


def rest_nodes(lattice: Lattice) -> np.ndarray:
    """Nodes of the undeformed body along the world's first axes, (n, 3)."""
    rest = np.zeros((len(lattice.nodes), 3))
    rest[:, : lattice.dim] = lattice.node_coordinates
    return rest


def still_clamp(lattice: Lattice, rest: np.ndarray, frames: int, clamped: bool = True) -> HeldNodes:
    """Nodes of the first layer of cells, held where they are."""
    nodes = np.unique(lattice.cell_nodes[lattice.cells[:, 0] < 1]) if clamped else np.empty(0, dtype=int)
    positions = np.repeat(rest[nodes][None], frames, axis=0)
    return HeldNodes(nodes, positions, np.zeros_like(positions))


def run(
    lattice: Lattice,
    law: Law,
    times: np.ndarray,
    *,
    gravity: np.ndarray = GRAVITY,
    velocity: np.ndarray | None = None,
    clamped: bool = True,
    drag_per_s: float = 0.0,
    terms: tuple[Term, ...] = (),
) -> np.ndarray:
    """Nodes over time, (T, n, 3), from rest (or ``velocity``, (n, 3)) in the undeformed shape."""
    rest = rest_nodes(lattice)
    problem = Problem(lattice, law, rest, gravity, drag_per_s=drag_per_s, terms=terms)
    start_velocity = np.zeros_like(rest) if velocity is None else velocity
    return TotalLagrangian(problem).run(
        rest, start_velocity, still_clamp(lattice, rest, len(times), clamped), times
    )


def material_point(lattice: Lattice, nodes: np.ndarray, coordinates: tuple[float, ...]) -> np.ndarray:
    """Path of one material point, (T, 3)."""
    row = lattice.interpolation(np.array([coordinates]))
    return np.asarray(row @ nodes.transpose(1, 0, 2).reshape(nodes.shape[1], -1)).reshape(-1, 3)


__all__ = [
    "GRAVITY",
    "NeoHookean",
    "RodLaw",
    "SheetLaw",
    "SolidLaw",
    "clamped_lattice",
    "material_point",
    "rest_nodes",
    "run",
    "still_clamp",
]
