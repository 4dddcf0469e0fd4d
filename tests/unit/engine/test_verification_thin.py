"""Ropes, rods and sheets against closed forms: limits are twice the error at this resolution, or less."""

from __future__ import annotations

import numpy as np

from benchmarks.verification import thin as thin


def order(coarse: float, fine: float) -> float:
    return float(np.log2(abs(coarse / fine)))


def test_a_clamped_rod_rings_as_euler_s_beam_at_second_order() -> None:
    coarse, fine = thin.rod_frequency(10), thin.rod_frequency(20)
    assert abs(fine) < 1.9e-3
    assert order(coarse, fine) > 1.8


def test_a_sagging_rod_is_the_heavy_elastica() -> None:
    assert thin.elastica(32) < 1.4e-3


def test_a_slack_rope_hangs_in_a_catenary() -> None:
    assert abs(thin.catenary(15)) < 1e-2


def test_a_hanging_rope_swings_as_bernoulli_s_chain() -> None:
    assert abs(thin.chain(32)) < 1.2e-3
    assert abs(thin.chain(16)) < 0.2 * abs(thin.chain(16, reach=0.0))


def test_a_clamped_plate_sags_and_rings_as_kirchhoff_s_at_second_order() -> None:
    coarse, fine = thin.plate_sag(6), thin.plate_sag(12)
    assert abs(fine) < 0.045
    assert order(coarse, fine) > 1.7
    assert abs(thin.plate_frequency(12)) < 0.015
