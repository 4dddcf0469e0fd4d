"""Discrete rods for the tests: chains, runs of one rod that leave their whole state, and an energy of our own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.rods.chain import Chain, chain
from physworld.engine.rods.discrete_rods import DiscreteRods, Launch, Sections
from physworld.materials.cable import CableLaw

FALL = np.array([0.0, 0.0, -9.81])
WEIGHTLESS = np.zeros(3)
LAW = CableLaw(stretching_n=200.0, bending_n_m2=2e-3, density_kg_m=0.05, torsion_ratio=0.8)


def line(edges: int, length: float = 1.0) -> Chain:
    """A rope of equal edges."""
    return chain(np.arange(-1, edges), np.full(edges + 1, length / edges))


def along(lattice: Chain, direction: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> np.ndarray:
    """Nodes of a straight rope [m], (n, 3)."""
    return lattice.distances[:, None] * np.array(direction)


def tree() -> Chain:
    """A cable of ten uneven edges; branches of four and three leave it at two places, a twig of two one of them."""
    parent = [-1, *range(10), 3, 11, 12, 13, 7, 15, 16, 12, 18]
    lengths = 0.05 * (1.0 + 0.4 * np.sin(np.arange(len(parent))))
    return chain(np.array(parent), lengths)


def still(nodes: list[int] | np.ndarray, start: np.ndarray, frames: int) -> HeldNodes:
    """Nodes that stay where they are."""
    nodes = np.asarray(nodes, dtype=int)
    positions = np.repeat(start[nodes][None], frames, axis=0)
    return HeldNodes(nodes, positions, np.zeros_like(positions))


def problem(
    lattice: Chain, law: CableLaw = LAW, frames: int = 2, natural: np.ndarray | None = None,
    gravity: np.ndarray = WEIGHTLESS, edges: tuple[int, ...] = (), turns: np.ndarray | None = None,
    radius_m: float = 0.004, settles: bool = False, **others: Any,
) -> Problem:  # fmt: skip
    """A rod: what does not stand here is straight, untwisted, weightless and free to turn."""
    count = len(lattice.parent)
    sections = Sections(
        natural=np.zeros((count, 3)) if natural is None else natural,
        radius_m=radius_m,
        edges=np.array(edges, dtype=int),
        turns=np.zeros((frames, len(edges))) if turns is None else turns,
        settles=settles,
    )
    return Problem(lattice, law, np.zeros((count, 3)), gravity, sections=sections, **others)


def uniform(lattice: Chain, first: float, second: float = 0.0, twist: float = 0.0) -> np.ndarray:
    """The same natural curvatures and twist at every joint [1/m], (n, 3)."""
    return np.tile([first, second, twist], (len(lattice.parent), 1))


@dataclass
class State:
    """Of a rod after a run: nodes (n, 3) [m], velocities [m/s], directors and spins [rad/s] of the edges."""

    x: np.ndarray
    v: np.ndarray
    directors: np.ndarray
    spin: np.ndarray


def run(
    one: Problem, start: np.ndarray, times: np.ndarray, dt: float | None = None,
    velocity: np.ndarray | None = None, held: HeldNodes | None = None,
) -> tuple[np.ndarray, State]:  # fmt: skip
    """Positions at ``times`` (T, n, 3) [m], and the state at the last of them (velocities half a step before)."""
    rods = DiscreteRods([one], dt)
    held = still([], start, len(times)) if held is None else held
    launch = Launch(rods, start, np.zeros_like(start) if velocity is None else velocity, [held], times)
    if one.sections is not None and one.sections.settles:
        launch.settle()
    path = launch.whole()[0]
    state = [array.numpy()[0] for array in launch.state[:4]]
    return path, State(*state)


def transported(directors: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Directors (n, 3) carried by the least rotations from unit tangents ``old`` to ``new``; Rodrigues' formula."""
    axis = np.cross(old, new)
    cosine = np.einsum("ij,ij->i", old, new)[:, None]
    return (
        cosine * directors
        + np.cross(axis, directors)
        + axis * np.einsum("ij,ij->i", axis, directors)[:, None] / (1.0 + cosine)
    )


def tangents(lattice: Chain, x: np.ndarray) -> np.ndarray:
    """Unit tangents of the edges, by the node at which they end, (n, 3)."""
    edges = x[1:] - x[lattice.parent[1:]]
    return np.concatenate([[[0.0, 0.0, 1.0]], edges / np.linalg.norm(edges, axis=1)[:, None]])


def energies(
    lattice: Chain, law: CableLaw, natural: np.ndarray, x: np.ndarray, directors: np.ndarray
) -> tuple[float, float, float]:
    """Stored in stretch, in bending and in twist [J] (Bergou et al. 2008), written for clarity."""
    t = tangents(lattice, x)
    second = np.cross(t, directors)
    stretch = bending = twist = 0.0
    for node in range(1, len(x)):
        p = lattice.parent[node]
        rest = lattice.lengths[node]
        stretch += 0.5 * law.stretching_n * (np.linalg.norm(x[node] - x[p]) - rest) ** 2 / rest
        if p == 0:
            continue
        length = 0.5 * (rest + lattice.lengths[p])
        binormal = 2.0 * np.cross(t[p], t[node]) / (1.0 + t[p] @ t[node])
        carried = transported(directors[[p]], t[[p]], t[[node]])[0]
        angle = np.arctan2(np.cross(carried, directors[node]) @ t[node], carried @ directors[node])
        k1 = 0.5 * binormal @ (second[p] + second[node]) / np.cos(0.5 * angle)
        k2 = -0.5 * binormal @ (directors[p] + directors[node]) / np.cos(0.5 * angle)
        off = (k1 - natural[node, 0] * length) ** 2 + (k2 - natural[node, 1] * length) ** 2
        bending += 0.5 * law.bending_n_m2 * off / length
        twist += 0.5 * law.torsion_n_m2 * (angle - natural[node, 2] * length) ** 2 / length
    return stretch, bending, twist
