"""Solids against closed forms: limits are twice the error that the engine shows at this resolution, or less."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.verification import solids as solids
from benchmarks.verification.cases import observed_order

pytestmark = pytest.mark.slow

ROUND_OFF = 1e-12


def order(coarse: float, fine: float, ratio: float = 2.0) -> float:
    """Order of convergence between two errors."""
    return float(np.log(abs(coarse / fine)) / np.log(ratio))


def test_free_fall_is_exact_at_any_time_step() -> None:
    assert abs(solids.free_fall(1.0)) < ROUND_OFF


def test_a_pulse_along_a_bar_converges_at_second_order() -> None:
    coarse, fine = solids.bar_wave(60), solids.bar_wave(120)
    assert fine < 0.11
    assert order(coarse, fine) > 1.7


def test_the_clamp_is_second_order_and_a_tenth_of_what_it_was() -> None:
    coarse, fine = solids.axial_frequency(10), solids.axial_frequency(20)
    assert abs(fine) < 1e-3
    assert order(coarse, fine) > 1.7
    assert abs(fine) < 0.1 * abs(solids.axial_frequency(20, reach=0.0))


def test_a_clamped_bar_swings_and_sags_as_timoshenko_s_beam() -> None:
    assert abs(solids.bending_frequency(20)) < 2.9e-3
    assert abs(solids.static_sag(20)) < 6.5e-3


def test_timoshenko_s_frequency_goes_to_euler_s_for_a_slender_beam() -> None:
    slender = solids.timoshenko_frequency(1.0, 0.005, 2e6, 1e6, 600.0)
    euler = solids.CLAMPED_FREE**2 * np.sqrt(2e6 * 0.005**2 / 12 / 600.0)
    assert slender == pytest.approx(euler, rel=1e-4)
    thick = solids.timoshenko_frequency(1.0, 0.1, 2e6, 1e6, 600.0)
    assert 0.98 < thick / (20 * euler) < 0.995


def test_torsion_converges_at_second_order_from_below() -> None:
    coarse, fine = solids.torsion_frequency(20), solids.torsion_frequency(40)
    assert -0.1 < fine < 0
    assert order(coarse, fine) > 1.4


def test_a_uniform_strain_under_a_large_rotation_leaves_inner_nodes_free_of_force() -> None:
    assert solids.rotation_patch(3) < 1e-7


def test_a_free_spin_of_three_turns_keeps_its_angular_momentum() -> None:
    assert abs(solids.spin(1.0)) < 1.4e-6


def test_a_sliding_block_stops_where_coulomb_says() -> None:
    assert abs(solids.sliding_block(2)) < 6e-4


def test_the_silicone_beam_is_not_damped_by_the_scheme() -> None:
    """The issue's bound is 0.002; measured are 6e-8 by energy and 2e-6 by amplitude."""
    assert abs(solids.silicone_decay(1.0)) < 3.2e-6


@pytest.mark.parametrize(("errors", "expected"), [([0.16, 0.04, 0.01], 2.0), ([0.4, 0.2, 0.1], 1.0)])
def test_observed_order_is_the_slope(errors: list[float], expected: float) -> None:
    sizes = np.array([1.0, 0.5, 0.25])
    assert observed_order(sizes, np.array(errors))[0] == pytest.approx(expected)
    found, limit = observed_order(sizes, np.array(errors) + 0.03, exact=False)
    assert found == pytest.approx(expected)
    assert limit == pytest.approx(0.03)
