"""Self-contact against closed forms: limits are twice the error at this resolution, or less."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.verification import contact as contact

pytestmark = pytest.mark.slow


def test_crossing_rods_come_as_near_to_a_diameter_as_cells_are_small() -> None:
    coarse, fine = contact.separation(11), contact.separation(22)
    assert -1.1e-3 < fine < 0
    assert np.log2(coarse / fine) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_rod_slides_on_others_as_coulomb_s_law_has_it(axis: int) -> None:
    assert abs(contact.slope(11, axis)) < 3e-3


def test_a_sheet_slides_on_itself_as_far_as_a_block() -> None:
    assert abs(contact.sliding_sheet(4)) < 2e-3


def test_a_rope_over_a_rope_holds_as_eytelwein_s_belt() -> None:
    assert abs(contact.belt(16)) < 5e-3


def test_ends_that_collide_keep_momentum_and_create_no_energy() -> None:
    assert contact.momentum(24) < 1e-13
    assert -1e-2 < contact.elastic(24) < 0
