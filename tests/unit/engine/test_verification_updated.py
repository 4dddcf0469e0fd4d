"""The updated Lagrangian form against closed forms, and what its transfers cost: limits at twice the error here."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.verification import solids as solids
from benchmarks.verification import updated as updated
from physworld.engine.updated.transfer import Apic, Asflip

pytestmark = pytest.mark.slow

SINGLE = 2e-6  # momentum is summed over particles in single precision


def test_a_fall_is_of_first_order_in_the_step() -> None:
    coarse, fine = updated.free_fall(1.0), updated.free_fall(0.5)
    assert fine < 8e-4
    assert np.log2(coarse / fine) > 0.9


def test_a_bar_rings_along_its_axis_as_it_should() -> None:
    assert abs(updated.axial_frequency(10)) < 0.012


def test_a_block_slides_as_far_as_friction_lets_it() -> None:
    assert abs(updated.sliding_block(4)) < 2e-3


def test_transfers_keep_momentum() -> None:
    assert updated.momentum(Apic(), 1.0) < SINGLE
    assert updated.momentum(Asflip(), 1.0) < SINGLE


def test_smaller_cells_and_asflip_damp_less() -> None:
    apic, finer, asflip = (
        updated.own_damping(Apic(), 7),
        updated.own_damping(Apic(), 10),
        updated.own_damping(Asflip(), 7),
    )
    assert 0.03 < apic < 0.07
    assert finer < 0.5 * apic and asflip < 0.25 * apic


def test_a_twisted_bar_is_in_balance_inside() -> None:
    assert solids.twist_patch(3) < 1e-6


def test_a_pulse_runs_at_the_speed_of_the_bar() -> None:
    coarse, fine = solids.bar_wave_speed(60), solids.bar_wave_speed(120)
    assert abs(fine) < 0.012
    assert np.log2(coarse / fine) > 1.7
