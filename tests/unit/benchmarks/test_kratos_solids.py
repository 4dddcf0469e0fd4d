"""Quadratic solids of Kratos fall as closed forms say, follow their hands, and are refused unless converged."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.peers.finite_elements import Acting
from benchmarks.trace import hidden_effects
from benchmarks.trace.hidden_cases import solid_cases
from benchmarks.trace.hidden_solids import (
    ALLOWED_M,
    SOLIDS,
    NotConvergedError,
    largest_change_m,
    without_stiffness,
)

pytest.importorskip("KratosMultiphysics", reason="Kratos comes with the extra bench")
from benchmarks.peers.kratos_solids import Solid

DRAG_PER_S = 5.0
LINES = ((0.0, 0.3, 1.0), (0.0, 1.0), (0.0, 0.5, 1.0))


def _block() -> Solid:
    return Solid(LINES, lambda unit: unit * [0.2, 0.1, 0.09], 5e4, 0.35, 540.0)


def test_a_free_body_falls_through_a_drag() -> None:
    times = np.arange(4) / 30.0
    block = _block()
    went = block.record(Acting(linear_drag_per_s=DRAG_PER_S), [], times, 2e-4)[-1] - block.nodes
    fall = 9.81 / DRAG_PER_S * (times[-1] - (1.0 - np.exp(-DRAG_PER_S * times[-1])) / DRAG_PER_S)
    assert went[:, 2] == pytest.approx(-fall, rel=2e-3)
    assert np.abs(went[:, :2]).max() < 1e-6


def test_a_held_end_pulls_the_rest() -> None:
    block, times = _block(), np.arange(6) / 30.0
    end = np.flatnonzero(block.nodes[:, 0] < 1e-9)
    places = block.record(
        Acting(gravity_m_s2=np.zeros(3)),
        [(end, lambda t: (np.eye(3), np.array([0.0, 0.3 * t, 0.0])))],
        times,
        2e-4,
    )
    went = (places[-1] - block.nodes)[:, 1]
    assert went[end] == pytest.approx(0.3 * times[-1])
    assert went.min() > 0.2 * 0.3 * times[-1]


def test_shape_functions_place_points_where_the_shape_does() -> None:
    unit = np.random.default_rng(0).uniform(size=(20, 3))
    block = _block()
    nodes, shares = block.weights(unit)
    assert np.einsum("pk,pki->pi", shares, block.nodes[nodes]) == pytest.approx(unit * [0.2, 0.1, 0.09])


def test_what_it_does_not_have_is_refused() -> None:
    with pytest.raises(ValueError, match="gravity, linear drag and pushes"):
        _block().record(Acting(tether_n_m=1.0), [], np.arange(2) / 30.0, 2e-4)
    with pytest.raises(FloatingPointError, match="not stable"):
        _block().record(Acting(), [(np.arange(3), lambda t: (np.eye(3), np.array([t, t, 0.0])))],
                        np.arange(6) / 30.0, 1.0 / 150.0)  # fmt: skip


@pytest.mark.slow
def test_a_recording_that_has_not_converged_is_refused() -> None:
    bar = replace(SOLIDS["thick bar"], coarse=((0.0, 1.0 / 12, 1.0), (0.0, 1.0), (0.0, 1.0)))
    bar = replace(bar, fine=((0.0, 1.0 / 12, 0.5, 1.0), (0.0, 1.0), (0.0, 1.0)))
    with pytest.raises(NotConvergedError, match=r"more than 0\.33 mm"):
        bar.recorder(1, np.random.default_rng(0)).tracks(Acting(), 0.0, np.arange(8) / 30.0)


def test_the_change_is_that_of_the_worst_frame() -> None:
    one = np.zeros((3, 4, 3))
    other = one.copy()
    other[1] = 2.0 * ALLOWED_M
    assert largest_change_m(one, other) == pytest.approx(2.0 * ALLOWED_M)


def test_half_of_the_recordings_have_no_effect() -> None:
    cases = solid_cases()
    assert sum(not case.acts for case in cases) * 2 == len(cases)


def test_what_a_stiffness_does_not_take_up_is_left() -> None:
    by, rest = np.zeros((2, 2, 3)), np.zeros((2, 2, 3))
    by[0], rest[1] = 1.0, 0.5
    share, left = without_stiffness(0.03 * by + rest, by)
    assert share == pytest.approx(0.03)
    assert left == pytest.approx(rest)


def test_a_refused_recording_is_not_traced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def refused(case: object, folder: Path) -> Path:
        raise NotConvergedError("coarser cells change it by 8.06 mm")

    monkeypatch.setattr(hidden_effects, "_made", refused)
    monkeypatch.setattr(hidden_effects, "traced", lambda *_: pytest.fail("it was traced"))
    monkeypatch.setattr(
        sys,
        "argv",
        ["hidden_effects", "--set", "hidden_solids", "--only", "s01", "--json", str(tmp_path / "rows.json")],
    )
    assert hidden_effects.main() == 1
