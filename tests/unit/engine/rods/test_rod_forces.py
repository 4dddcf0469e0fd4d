"""Forces and torques of a discrete rod against the gradient of an energy written here, and its balances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from discrete import FALL, LAW, State, along, energies, line, problem, run, still, tangents, transported, tree

from physworld.engine.rods import discrete_rods
from physworld.engine.rods.chain import Chain, chain
from physworld.engine.rods.discrete_rods import DiscreteRods, Launch, directors_along, joint_angles

INSTANT = 1e-9  # a step [s] in which a force accelerates and nothing else happens
THICK = 0.5  # radius [m] of a section whose inertia about its axis is not small


def crumpled(lattice: Chain, seed: int) -> np.ndarray:
    """Nodes of a rod that bends by up to 100 degrees a joint and is stretched by some percent."""
    rng = np.random.default_rng(seed)
    x = np.zeros((len(lattice.parent), 3))
    for node in range(1, len(x)):
        way = np.array([1.0, 0.0, 0.0]) + 0.9 * rng.normal(size=3)
        stretch = 1.0 + 0.05 * rng.normal()
        x[node] = x[lattice.parent[node]] + way / np.linalg.norm(way) * lattice.lengths[node] * stretch
    return x


def twisted(lattice: Chain, x: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Directors turned by ``angles`` (n,) [rad] about the tangents from those without twist."""
    t, d = tangents(lattice, x), directors_along(lattice, x)
    return d * np.cos(angles)[:, None] + np.cross(t, d) * np.sin(angles)[:, None]


def slopes(of: Callable[[np.ndarray], float], at: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Central differences of a function of an array, of its shape."""
    found = np.zeros_like(at)
    for place in np.ndindex(at.shape):
        shift = np.zeros_like(at)
        shift[place] = step
        found[place] = (of(at + shift) - of(at - shift)) / (2.0 * step)
    return found


@pytest.mark.parametrize(
    ("lattice", "twist"), [(line(8, 0.5), 0.0), (line(8, 0.5), 0.7), (tree(), 0.7)],
    ids=["untwisted", "twisted", "branched"],
)  # fmt: skip
def test_forces_and_torques_are_the_gradient_of_the_energy(lattice: Chain, twist: float) -> None:
    rng = np.random.default_rng(4)
    count = len(lattice.parent)
    x, natural = crumpled(lattice, 3), 3.0 * rng.normal(size=(count, 3))
    directors = twisted(lattice, x, twist * rng.normal(size=count))
    one = problem(lattice, natural=natural, radius_m=THICK)
    launch = Launch(
        DiscreteRods([one], INSTANT), x, np.zeros_like(x), [still([], x, 2)], np.array([0.0, INSTANT])
    )
    launch.state[2].assign(directors[None])
    launch.whole()
    state = State(*(array.numpy()[0] for array in launch.state[:4]))
    mass = one.nodal_mass()
    forces = mass[:, None] * state.v / (0.5 * INSTANT)  # the first push is that of half a step
    edge_mass = 0.5 * (mass + mass[np.maximum(lattice.parent, 0)])
    torques = 0.5 * edge_mass * THICK**2 * state.spin / INSTANT
    straight = tangents(lattice, x)

    def energy(nodes: np.ndarray, angles: np.ndarray) -> float:
        t = tangents(lattice, nodes)
        carried = transported(directors, straight, t)
        carried = carried * np.cos(angles)[:, None] + np.cross(t, carried) * np.sin(angles)[:, None]
        return sum(energies(lattice, LAW, natural, nodes, carried))

    none = np.zeros(count)
    expected = -slopes(lambda nodes: energy(nodes, none), x)
    # the damping of stretch makes a step of 1e-9 s smaller by up to 1e-5
    assert forces == pytest.approx(expected, abs=2e-5 * np.abs(expected).max())
    expected = -slopes(lambda angles: energy(x, angles), none)
    expected[0] = 0.0  # no edge ends at the first node
    assert torques == pytest.approx(expected, abs=1e-7 * np.abs(expected).max())


def test_a_body_that_moves_without_deforming_is_not_pushed() -> None:
    lattice = tree()
    x = crumpled(lattice, 5)
    natural = np.zeros((len(x), 3))
    bent = lattice.parent > 0
    natural[bent, :2] = joint_angles(lattice, x)[bent] / lattice.joint_lengths[bent, None]
    lengths = np.linalg.norm(x[1:] - x[lattice.parent[1:]], axis=1)
    unstretched = chain(lattice.parent, np.concatenate([[0.0], lengths]))
    natural[bent] *= (lattice.joint_lengths[bent] / unstretched.joint_lengths[bent])[:, None]
    pace = np.array([0.3, -0.2, 0.5])
    one = problem(unstretched, natural=natural)
    path, _ = run(one, x, np.array([0.0, 0.5]), 2e-3, np.tile(pace, (len(x), 1)))
    assert path[-1] == pytest.approx(x + 0.5 * pace, abs=1e-10)


def spread(lattice: Chain) -> np.ndarray:
    """Velocities [m/s] that bend a rod in two planes, a few times over its length."""
    s = lattice.distances
    v = np.zeros((len(s), 3))
    v[:, 1], v[:, 2] = 0.7 * np.sin(2.0 * np.pi * s**2), np.cos(3.0 * np.pi * s)
    return v


@pytest.mark.parametrize("lattice", [line(20), tree()], ids=["rope", "branched"])
def test_a_free_rod_keeps_its_momentum(lattice: Chain) -> None:
    x = along(lattice)
    x[:, 1] += 0.1 * np.sin(9.0 * np.arange(len(x)))
    one = problem(lattice, natural=np.full((len(x), 3), 2.0))
    mass = one.nodal_mass()[:, None]
    v = spread(lattice)
    _, state = run(one, x, np.array([0.0, 1.0]), 2e-3, v)
    before, after = np.sum(mass * v, axis=0), np.sum(mass * state.v, axis=0)
    assert after == pytest.approx(before, abs=1e-12 * np.abs(mass * v).sum())


def test_a_free_rod_falls_as_a_stone() -> None:
    lattice = tree()
    x = along(lattice)
    one = problem(lattice, gravity=FALL)
    path, _ = run(one, x, np.array([0.0, 0.3, 0.4]), 1e-3)
    drop = np.array([0.3, 0.4])[:, None] ** 2 * 0.5 * FALL
    assert (path[1:] - x).mean(axis=1) == pytest.approx(drop, abs=1e-12)
    assert np.ptp(path[-1] - x, axis=0) == pytest.approx(0.0, abs=1e-12)


def drifts(dt: float, monkeypatch: pytest.MonkeyPatch) -> tuple[float, float]:
    """Largest relative changes of energy and of angular momentum over four seconds of a free rod without damping."""
    monkeypatch.setattr(discrete_rods, "_STRETCH_RELAXATION_S", 0.0)
    monkeypatch.setattr(discrete_rods, "_LEAST_TORSION", 0.0)
    lattice = line(20)
    x, v = along(lattice), spread(lattice)
    law = replace(LAW, torsion_ratio=0.0)  # what twist stores dies out within a few steps
    one = problem(lattice, law)
    times = np.arange(round(4.0 / dt) + 1) * dt
    path, _ = run(one, x, times, dt, v)
    mass = one.nodal_mass()[:, None]
    rate = (path[2:] - path[:-2]) / (2.0 * dt)
    found = []
    for nodes, speed in list(zip(path[1:-1], rate, strict=True))[:: round(0.04 / dt)]:
        stretch, bending, _ = energies(
            lattice, law, one.sections.natural, nodes, directors_along(lattice, nodes)
        )
        moment = np.sum(mass * np.cross(nodes, speed), axis=0)
        found.append([stretch + bending + 0.5 * np.sum(mass * speed**2), *moment])
    values = np.array(found)
    energy = 0.5 * np.sum(mass * v**2)
    moment = np.sum(mass * np.cross(x, v), axis=0)
    off = np.linalg.norm(values[:, 1:] - moment, axis=1).max() / np.linalg.norm(moment)
    return float(np.abs(values[:, 0] / energy - 1.0).max()), float(off)


def test_energy_and_angular_momentum_drift_by_the_square_of_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse, fine = drifts(1e-3, monkeypatch), drifts(5e-4, monkeypatch)
    assert fine[0] < 2e-4
    assert fine[1] < 2e-5
    assert coarse[0] / fine[0] > 3.0
    assert coarse[1] / fine[1] > 3.0
