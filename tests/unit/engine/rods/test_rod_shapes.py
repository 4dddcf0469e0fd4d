"""Shapes in which discrete rods rest against closed forms: beams, catenary, coils, helices, twist and its buckling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discrete import FALL, LAW, along, line, problem, run, still, tangents, uniform
from scipy.optimize import brentq

from benchmarks.verification.thin import heavy_elastica
from physworld.engine.problem import HeldNodes
from physworld.engine.rods.chain import Chain

LENGTH = 0.6
NOW = np.array([0.0, 1e-3])
GREENHILL = (
    2.0 * 4.493409457909064
)  # of twice the first root of tan x = x: twist moment over B / L, ends clamped


def clamped(edges: int, length: float = LENGTH) -> tuple[Chain, np.ndarray]:
    """A rope along x whose clamp, the middle of its first edge, is at 0 and whose free part is of ``length``."""
    size = length / (edges - 0.5)
    lattice = line(edges, edges * size)
    return lattice, along(lattice) - np.array([0.5 * size, 0.0, 0.0])


def settled(lattice: Chain, start: np.ndarray, held: HeldNodes | None = None, **others: object) -> np.ndarray:
    """Nodes (n, 3) [m] of a rod that came to rest."""
    path, _ = run(problem(lattice, settles=True, **others), start, NOW, held=held)  # type: ignore[arg-type]
    return path[0]


def sag(edges: int) -> float:
    """Relative error of the small deflection of a cantilever against w L^4 / 8 B."""
    lattice, start = clamped(edges)
    law = replace(LAW, bending_n_m2=5.0)  # it sags by 0.2 mm
    tip = settled(lattice, start, still([0, 1], start, 2), gravity=FALL, edges=(1,), law=law)[-1, 2]
    return float(-tip / (law.density * 9.81 * LENGTH**4 / (8.0 * law.bending_n_m2)) - 1.0)


def test_a_cantilever_deflects_as_euler_s_beam_at_second_order() -> None:
    coarse, fine = sag(10), sag(20)
    assert abs(fine) < 2e-3
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.3)


def test_a_sagging_rod_is_the_heavy_elastica() -> None:
    lattice, start = clamped(40)
    exact = heavy_elastica(LAW.bending_n_m2, LAW.density * 9.81, LENGTH)
    law = replace(LAW, stretching_n=5000.0)
    tip = settled(lattice, start, still([0, 1], start, 2), gravity=FALL, edges=(1,), law=law)[-1]
    assert np.hypot(tip[0] - exact[0], tip[2] - exact[1]) < 2e-3 * LENGTH


def test_a_rope_that_does_not_bend_hangs_in_a_catenary() -> None:
    span, edges = 0.7, 40
    lattice = line(edges)
    half = brentq(lambda a: np.sin(a) / a - span, 0.1, 3.0)  # it starts as an arc
    angle = (lattice.distances - 0.5) * 2.0 * half
    start = np.stack([np.sin(angle), 0.0 * angle, np.cos(half) - np.cos(angle)], axis=1) / (2.0 * half)
    law = replace(LAW, bending_n_m2=1e-8, stretching_n=2000.0)
    rest = settled(lattice, start, still([0, edges], start, 2), gravity=FALL, law=law)
    scale = brentq(lambda a: 2.0 * a * np.sinh(span / (2.0 * a)) - 1.0, 0.02, 10.0)
    exact = scale * (np.cosh(rest[:, 0] / scale) - np.cosh(span / (2.0 * scale)))
    assert rest[:, 2] == pytest.approx(exact, abs=2e-3)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_rod_with_a_curvature_of_its_own_is_an_arc(axis: int) -> None:
    lattice, curvature = line(30, LENGTH), 4.0
    natural = uniform(lattice, *(curvature * np.eye(2)[axis]))
    rest = settled(lattice, along(lattice), natural=natural)
    middle = 0.5 * (rest[1:] + rest[:-1])
    # middles of edges whose joints turn by 2 atan(k l / 2) lie on a circle
    size = LENGTH / 30
    radius = 0.5 * size / np.tan(np.arctan(0.5 * curvature * size))
    centre = middle.mean(axis=0)
    fit = np.linalg.svd(middle - centre)[2]
    flat = (middle - centre) @ fit[:2].T
    solved = np.linalg.lstsq(
        np.column_stack([2.0 * flat, np.ones(len(flat))]), (flat**2).sum(axis=1), rcond=None
    )[0]
    found = np.linalg.norm(flat - solved[:2], axis=1)
    assert found == pytest.approx(radius, rel=1e-3)
    assert radius == pytest.approx(1.0 / curvature, rel=1e-3)
    assert np.abs((middle - centre) @ fit[2]).max() < 1e-6


def test_a_rod_with_curvature_and_twist_of_its_own_is_a_helix() -> None:
    lattice, curvature, torsion = line(60, 1.5), 6.0, 5.0
    rest = settled(lattice, along(lattice), natural=uniform(lattice, curvature, 0.0, torsion))
    square = curvature**2 + torsion**2
    radius, advance = (
        curvature / square,
        torsion / np.sqrt(square),
    )  # of the helix, and along its axis by arc length
    turns = tangents(lattice, rest)[1:]
    axis = np.linalg.svd(turns - turns.mean(axis=0))[2][2]
    assert np.abs(turns @ axis) == pytest.approx(advance, abs=5e-3)
    across = rest - np.outer(rest @ axis, axis)
    spans = np.linalg.norm(across[:, None] - across[None], axis=2)
    assert spans.max() == pytest.approx(2.0 * radius, rel=2e-2)


def rolled(
    angle: float, times: np.ndarray, lattice: Chain, start: np.ndarray
) -> tuple[HeldNodes, np.ndarray]:
    """Both ends held, the last edge rolled by ``angle`` up to the second time: the grips, and turns (T, 2)."""
    count = len(lattice.parent)
    turns = np.zeros((len(times), 2))
    turns[1:, 1] = angle
    return still([0, 1, count - 2, count - 1], start, len(times)), turns


def test_twist_of_a_straight_rod_is_shared_evenly_and_follows_the_roll_of_its_grips() -> None:
    lattice, angle = line(12, LENGTH), 1.2
    start, times = along(lattice), np.array([0.0, 0.2, 1.0])
    held, turns = rolled(angle, times, lattice, start)
    one = problem(lattice, edges=(1, 12), turns=turns)
    path, state = run(one, start, times, held=held)
    t = tangents(lattice, path[-1])
    first, others = state.directors[1], state.directors[1:]
    found = np.arctan2(np.cross(first, others) @ t[1], others @ first)
    assert found == pytest.approx(angle * np.arange(12) / 11.0, abs=1e-6)


def loudness(share: float) -> float:
    """By how much a bend of a rod, clamped at both ends and twisted by ``share`` of Greenhill's angle, grew in 3 s."""
    edges = 30
    size = LENGTH / (edges - 1)  # clamps are the middles of the end edges
    lattice = line(edges, edges * size)
    start = along(lattice)
    law = replace(LAW, torsion_ratio=1.0, relaxation_s=0.03)
    times = np.linspace(0.0, 4.0, 41)
    held, turns = rolled(share * GREENHILL / law.torsion_ratio, times, lattice, start)
    velocity = np.zeros_like(start)
    velocity[:, 1] = 1e-4 * np.sin(np.pi * lattice.distances / lattice.distances[-1])
    one = problem(lattice, law, edges=(1, edges), turns=turns)
    path, _ = run(one, start, times, velocity=velocity, held=held)
    bend = np.linalg.norm(path[:, :, 1:], axis=2).max(axis=1)
    return float(bend[-1] / bend[10])


def test_a_twisted_rod_buckles_at_greenhill_s_angle() -> None:
    assert loudness(0.97) < 0.7
    assert loudness(1.03) > 1.5


def test_what_settles_is_in_static_equilibrium() -> None:
    lattice, start = clamped(20)
    natural = uniform(lattice, 1.0, 2.0, 1.5)
    held = still([0, 1], start, 201)
    one = problem(lattice, settles=True, natural=natural, gravity=FALL, edges=(1,), frames=201)
    path, _ = run(one, start, np.linspace(0.0, 2.0, 201), held=held)
    assert np.abs(path - path[0]).max() < 1e-3 * LENGTH
    assert path[0, -1, 2] < -0.1 * LENGTH
