"""Twisted ropes against Greenhill, Michell and Gauss: limits are twice the error at this resolution, or less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.verification import twist as twist
from benchmarks.verification.cases import hold
from physworld.engine.problem import Problem
from physworld.engine.thin.twist import Twist, span_between
from physworld.engine.total.formulation import TotalLagrangian


def order(coarse: float, fine: float) -> float:
    return float(np.log2(abs(coarse / fine)))


def test_a_straight_rod_between_clamps_buckles_at_greenhill_s_moment() -> None:
    assert pytest.approx(8.9868, abs=1e-4) == twist.GREENHILL
    coarse, fine = twist.greenhill(12), twist.greenhill(24)
    assert abs(fine) < 0.03
    assert order(coarse, fine) > 1.8


def test_a_ring_leaves_its_plane_at_michell_s_twist() -> None:
    assert abs(twist.michell(32)) < 0.03


def test_a_closed_ribbon_s_twist_is_what_the_writhe_leaves_of_its_link() -> None:
    coarse, fine = twist.writhe(24), twist.writhe(48)
    assert abs(fine) < 6e-3
    assert order(coarse, fine) > 1.8


@pytest.mark.parametrize(("share", "buckles"), [(0.9, False), (1.15, True)])
def test_a_run_stays_straight_below_the_critical_turn_and_buckles_above(share: float, buckles: bool) -> None:
    """The grip turns slowly to a share of this lattice's critical angle and stays; a breath of air starts it."""
    cells = 16
    lattice, s, free = twist._lattice(cells)
    rest = np.zeros((len(s), 3))
    rest[:, 0] = s
    law = replace(twist.ROD, stretching_n=500.0)
    critical = twist.GREENHILL * (1 + twist.greenhill(cells)) / law.torsion_ratio
    times = np.linspace(0.0, 1.0, 61)
    angle = share * critical * np.clip(times / 0.3, 0, 1)
    spin = twist.Rotation.from_rotvec(angle[:, None] * np.array([1.0, 0, 0])).as_matrix()
    still = np.repeat(np.eye(3)[None], len(times), axis=0)
    span = span_between(lattice, rest, (0.0, twist.LENGTH), np.stack([still, spin]), times)
    assert span is not None
    problem = Problem(lattice, law, rest, np.zeros(3), drag_per_s=2.0, terms=(Twist((span,)),))
    velocity = np.zeros_like(rest)
    velocity[free, 1:] = 1e-4 * np.random.default_rng(0).normal(size=(len(free), 2))
    held = hold(np.setdiff1d(np.arange(len(s)), free), rest, len(times))
    nodes = TotalLagrangian(problem).run(rest, velocity, held, times)
    aside = float(np.linalg.norm(nodes[-1, :, 1:], axis=1).max())
    assert (aside > 0.01 * twist.LENGTH) if buckles else (aside < 1e-4 * twist.LENGTH)
