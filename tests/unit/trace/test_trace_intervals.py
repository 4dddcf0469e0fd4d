"""Intervals of refitted numbers against those of a straight line through noisy points."""

from __future__ import annotations

import numpy as np
import pytest
from sagging_bar import BUDGET, sagging

from physworld.effects.registry import effect
from physworld.estimation.refit import Refit
from physworld.estimation.unknowns import Unknown
from physworld.trace.candidates import candidates
from physworld.trace.intervals import spread_of
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


@pytest.mark.parametrize("blocks", [1, 2, 12])
@pytest.mark.parametrize("noise", [0.5, 3.0])
def test_an_interval_is_as_wide_as_the_noise_leaves_it_however_few_the_blocks(
    blocks: int, noise: float
) -> None:
    fitted = line(noise)
    deviation = np.sqrt(np.diag(np.linalg.inv(fitted.jacobian.T @ fitted.jacobian))) * max(1.0, fitted.misfit)
    found = spread_of(fitted, np.arange(ROWS) * blocks // ROWS, {}, 500, 0).numbers()
    for name, value, spread in zip(("offset", "slope"), (0.3, 2.0), deviation, strict=True):
        low, high = found[name].ci95
        assert low <= value - 1.95 * spread and high >= value + 1.95 * spread
        assert high - low < 8 * spread


def test_a_number_that_the_data_do_not_see_may_be_anything_within_its_bounds() -> None:
    fitted = line()
    fitted.jacobian[:, 1] = 0.0
    assert spread_of(fitted, np.zeros(ROWS, dtype=int), {}, 100, 0).numbers()["slope"].ci95 == (-50.0, 50.0)


@pytest.mark.parametrize("finer", [{}, {"gravity_tilt.tilt_y_rad": 0.06}])
def test_what_the_numbers_imply_has_an_interval_too(finer: dict[str, float]) -> None:
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
    angle = spread_of(fitted, np.arange(4000) // 100, finer, 2000, 0).derived("gravity_tilt")["tilt_deg"]
    assert angle.value == pytest.approx(np.degrees(0.05)) and angle.unit == "deg"
    spread = np.degrees(np.linalg.norm(tilt / 0.05 * deviation))
    low, high = angle.ci95
    assert low == pytest.approx(angle.value - 1.96 * spread, abs=0.15 * spread)
    there = angle.value + np.degrees(0.8 * 0.02) if finer else angle.value + 1.96 * spread
    assert high == pytest.approx(there, abs=0.15 * spread)
