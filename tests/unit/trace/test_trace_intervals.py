"""Intervals of refitted numbers against those of a straight line through noisy points."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sagging_bar import BUDGET, sagging

from physworld.effects.registry import effect
from physworld.estimation.left_out import LeftOut
from physworld.estimation.refit import Refit
from physworld.estimation.unknowns import Unknown
from physworld.trace.candidates import candidates
from physworld.trace.intervals import Spread, spread_of
from physworld.twin.build import build_twin

ROWS = 60
TIMES = np.linspace(0.0, 1.0, ROWS)


def line(noise: float = 1.0) -> Refit:
    """Least squares of intercept and slope, whitened; the optimum is at (0.3, 2)."""
    slopes = np.stack([np.ones(ROWS), 10 * TIMES], axis=1)
    left = noise * np.random.default_rng(0).normal(size=ROWS)
    left -= slopes @ np.linalg.lstsq(slopes, left, rcond=None)[0]
    unknowns = [
        Unknown(name, "1", -50.0, 50.0, lambda twin, v: twin, start=start)
        for name, start in (("offset", 0.3), ("slope", 2.0))
    ]
    return Refit(unknowns, build_twin(sagging(), BUDGET), np.array([0.3, 2.0]), np.empty(0), left, slopes)


def spread(fitted: Refit, blocks: int, resamples: int, error: float = 1.0) -> Spread:
    """Under blocks of equal size, with this left-out error."""
    rows = np.array_split(np.arange(len(fitted.residual)), blocks)
    unseen = LeftOut(np.full(blocks, error), np.array([len(own) for own in rows]))
    model: Any = SimpleNamespace(fitted=fitted, unseen=unseen)
    return spread_of(model, rows, resamples, 0)


@pytest.mark.parametrize("blocks", [1, 2, 12])
@pytest.mark.parametrize("noise", [0.5, 1.0])
def test_an_interval_is_as_wide_as_the_noise_leaves_it_however_few_the_blocks(
    blocks: int, noise: float
) -> None:
    fitted = line(noise)
    deviation = np.sqrt(np.diag(np.linalg.inv(fitted.jacobian.T @ fitted.jacobian)))
    found = spread(fitted, blocks, 500).numbers()
    for name, value, own in zip(("offset", "slope"), (0.3, 2.0), deviation, strict=True):
        low, high = found[name].ci95
        assert low <= value - 1.95 * own and high >= value + 1.95 * own
        assert high - low < 8 * own


def test_a_number_that_the_data_do_not_see_may_be_anything_within_its_bounds() -> None:
    fitted = line()
    fitted.jacobian[:, 1] = 0.0
    assert spread(fitted, 1, 100).numbers()["slope"].ci95 == (-50.0, 50.0)


def test_what_the_numbers_imply_has_an_interval_too() -> None:
    tilt, deviation = np.array([0.03, 0.04]), np.array([0.002, 0.004])
    twin = build_twin(sagging(), BUDGET).with_effect(
        effect("gravity_tilt", tilt_x_rad=tilt[0], tilt_y_rad=tilt[1])
    )
    gates = candidates(twin, ("gravity_tilt",))[0][0].unknowns()[:2]
    probes = np.array([gate.value(1.0) for gate in gates])
    rng = np.random.default_rng(0)
    slopes = np.linalg.qr(rng.normal(size=(4000, 2)))[0] * probes / deviation
    left = rng.normal(size=4000)
    left -= slopes @ np.linalg.lstsq(slopes, left, rcond=None)[0]
    fitted = Refit(gates, twin, tilt / probes, np.empty(0), left, slopes)
    angle = spread(fitted, 40, 2000).derived("gravity_tilt")["tilt_deg"]
    assert angle.value == pytest.approx(np.degrees(0.05)) and angle.unit == "deg"
    own = np.degrees(np.linalg.norm(tilt / 0.05 * deviation))
    low, high = angle.ci95
    assert low == pytest.approx(angle.value - 1.96 * own, abs=0.15 * own)
    assert high == pytest.approx(angle.value + 1.96 * own, abs=0.15 * own)


def test_an_interval_is_wider_where_blocks_share_an_error() -> None:
    """Three quarters of the squared error are shared by the rows of each of twelve blocks."""
    fitted = line()
    alone, shared = (spread(fitted, 12, 100, error).covariance for error in (1.0, 4.0))
    worth = 1.0 / ((1 / 4) ** 2 / ROWS + (3 / 4) ** 2 / 12)
    np.testing.assert_allclose(shared, alone * 4.0 * ROWS / worth, rtol=1e-6)
