"""The chain against closed forms: a rigid pendulum, a sagging cantilever, twist by parallel transport, momentum."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from physworld.arrays import Array
from physworld.baselines.chain import Chain, Coefficients, _Stepper
from physworld.geometry.rigid import least_rotation

GRAVITY = np.array([0.0, 0.0, -9.81])


def of(bending: float = 0.0, damping: float = 0.0, drag: float = 0.0, twist: float = 0.0) -> Coefficients:
    return Coefficients(*(np.array([value]) for value in (bending, damping, drag, twist)))


def test_a_rigid_link_swings_as_a_physical_pendulum() -> None:
    length, angle = 0.5, 0.05
    chain = Chain(np.array([length]), np.array([True, False]), lumped=False)
    start = np.array([[0.0, 0, 0], [length * np.sin(angle), 0, -length * np.cos(angle)]])
    times = np.arange(0.0, 2.5, 0.002)
    hinge = np.zeros((len(times), 1, 3))
    x = chain.run(start, np.zeros((2, 3)), hinge, times, GRAVITY, of())[0, :, 1, 0]
    down = np.flatnonzero((x[:-1] > 0) & (x[1:] <= 0))
    crossings = times[down] + 0.002 * x[down] / (x[down] - x[down + 1])
    expected = 2 * np.pi * np.sqrt(2 * length / (3 * 9.81)) * (1 + angle**2 / 16)
    assert np.diff(crossings).mean() == pytest.approx(expected, rel=2e-4)  # the step's phase error


def test_a_cantilever_sags_as_a_beam() -> None:
    links, length, bending = 24, 1.0, 100.0
    lengths = np.full(links + 1, length / links)
    chain = Chain(lengths, np.arange(links + 2) < 2, lumped=True)
    x = np.cumsum(np.concatenate([[-lengths[0]], lengths]))
    start = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
    held = np.repeat(start[None, :2], 2, axis=0)
    found = chain.run(start, np.zeros_like(start), held, np.array([0.0, 3.0]), GRAVITY, of(bending, 0.5, 8.0))
    deflection = -found[0, -1, -1, 2]
    # the clamped joint bends over half a link on its held side too
    root = length + 0.5 * length / links
    assert deflection == pytest.approx(9.81 * root**4 / (8 * bending), rel=5e-3)


def test_lengths_are_kept_and_a_free_chain_keeps_its_momentum() -> None:
    rng = np.random.default_rng(0)
    start = np.cumsum(rng.normal(size=(8, 3)), axis=0)
    lengths = np.linalg.norm(np.diff(start, axis=0), axis=1)
    chain = Chain(lengths, np.zeros(8, dtype=bool), lumped=True)
    velocity = rng.normal(size=(8, 3))
    times = np.linspace(0.0, 0.5, 51)
    nodes = chain.run(start, velocity, np.zeros((51, 0, 3)), times, np.zeros(3), of(0.5))[0]
    found = np.linalg.norm(np.diff(nodes, axis=1), axis=2)
    assert np.abs(found / lengths - 1).max() < 1e-6
    weights = chain.mass.sum(axis=0)
    centre = nodes.transpose(0, 2, 1) @ weights / weights.sum()
    speed = weights @ velocity / weights.sum()
    assert centre[-1] - centre[0] == pytest.approx(0.5 * speed, abs=1e-6)


def test_twist_is_what_parallel_transport_says() -> None:
    """Frames carried along the chain and frames carried in time by its last link differ by minus the twist."""

    def shape(share: float) -> Array:
        s = np.linspace(0.0, 3.0, 9)
        bent = np.stack([s, share * np.sin(s), share * 0.8 * np.cos(2 * s)], axis=1)
        return np.asarray(bent)

    chain = Chain(np.ones(8), np.zeros(9, dtype=bool), lumped=True)
    stepper = _Stepper(chain, of(), np.zeros(3))
    shapes = [shape(share) for share in np.linspace(0.0, 1.0, 401)]
    twist, first, last = 0.0, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])
    for a, b in pairwise(shapes):
        slope = 0.5 * (stepper._twist_slope(a[None]) + stepper._twist_slope(b[None]))
        twist += float(np.sum(slope * (b - a)))
        first = least_rotation(a[1] - a[0], b[1] - b[0]) @ first
        last = least_rotation(a[-1] - a[-2], b[-1] - b[-2]) @ last
    links = np.diff(shapes[-1], axis=0)
    carried = first
    for before, after in pairwise(links):
        carried = least_rotation(before, after) @ carried
    axis = links[-1] / np.linalg.norm(links[-1])
    angle = np.arctan2(axis @ np.cross(carried, last), carried @ last)
    assert abs(angle) > 0.05
    assert twist == pytest.approx(-angle, abs=1e-4)  # the path's own steps
