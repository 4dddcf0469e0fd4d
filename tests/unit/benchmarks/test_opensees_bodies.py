"""Beams of OpenSees swing and sag as closed forms say, fall through a drag, and follow their hands."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.peers.finite_elements import Acting

pytest.importorskip("opensees", reason="OpenSees is not installed: pip install opensees")
from benchmarks.peers.opensees_bodies import Mesh, plate, rod

DRAG_PER_S = 5.0
LENGTH_M, RADIUS_M, YOUNG_PA, DENSITY = 0.3, 0.01, 5e7, 900.0
STILL = np.eye(3), np.zeros(3)


def _beam() -> Mesh:
    return rod(np.zeros(3), np.array([1.0, 0.0, 0.0]), LENGTH_M, RADIUS_M, YOUNG_PA, 0.4, DENSITY, 16)


def test_a_cantilever_let_go_of_swings_by_twice_its_sag_at_its_frequency() -> None:
    area, inertia = np.pi * RADIUS_M**2, 0.25 * np.pi * RADIUS_M**4
    sag = DENSITY * area * 9.81 * LENGTH_M**4 / (8.0 * YOUNG_PA * inertia)
    rate = 3.516 * np.sqrt(YOUNG_PA * inertia / (DENSITY * area)) / LENGTH_M**2
    times = np.arange(41) * (2.0 * np.pi / rate) / 40.0
    acting = Acting(gravity_m_s2=np.array([0.0, 0.0, -9.81]))
    tip = _beam().record(acting, [(np.array([0]), lambda _: STILL)], times)[:, -1, 2]
    assert tip.min() == pytest.approx(-2.0 * sag, rel=0.03)
    assert times[int(np.argmin(tip))] == pytest.approx(np.pi / rate, rel=0.06)
    assert abs(tip[-1]) < 0.1 * sag


def test_a_free_body_falls_through_a_drag() -> None:
    times = np.arange(4) / 30.0
    for body in (_beam(), plate(np.zeros(3), 0.2, 0.1, (2, 2), 0.01, 3e5, 0.35, 400.0)):
        went = body.record(Acting(linear_drag_per_s=DRAG_PER_S), [], times)[-1] - body.nodes
        fall = 9.81 / DRAG_PER_S * (times[-1] - (1.0 - np.exp(-DRAG_PER_S * times[-1])) / DRAG_PER_S)
        assert went[:, 2] == pytest.approx(-fall, rel=1e-4)
        assert np.abs(went[:, :2]).max() < 1e-6


def test_held_nodes_go_where_the_hand_goes_and_the_rest_follows() -> None:
    times = np.arange(11) / 30.0
    body = _beam()
    found = body.record(
        Acting(gravity_m_s2=np.zeros(3)),
        [(np.array([0, 1]), lambda time: (np.eye(3), 0.05 * np.array([time, 0.0, time**2])))],
        times,
    )
    moved = found[:, :2] - body.nodes[:2]
    assert moved == pytest.approx(
        0.05 * np.stack([times, 0 * times, times**2], axis=1)[:, None] * np.ones((1, 2, 1))
    )
    assert np.linalg.norm(found[-1, -1] - body.nodes[-1]) > 1e-3


def test_other_effects_are_refused() -> None:
    with pytest.raises(ValueError, match="gravity and linear drag"):
        _beam().record(Acting(viscosity_pa_s=1.0), [], np.arange(2) / 30.0)
