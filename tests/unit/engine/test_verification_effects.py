"""Effects against closed forms, and a beam against finite elements: limits are twice the error here, or less."""

from __future__ import annotations

import numpy as np

from benchmarks.verification import effects as effects
from benchmarks.verification import peers as peers


def test_a_fall_with_drag_follows_its_closed_form_at_first_order_in_the_step() -> None:
    coarse, fine = effects.drag(1.0), effects.drag(0.5)
    assert fine < 5.8e-4
    assert np.log2(coarse / fine) > 0.9


def test_drag_takes_half_its_rate_from_a_swing() -> None:
    assert abs(effects.swing_drag(10)) < 3e-4


def test_internal_friction_damps_as_kelvin_and_voigt_say() -> None:
    assert abs(effects.viscosity(20)) < 1.8e-3
    assert abs(effects.rod_friction(10)) < 0.015


def test_strong_friction_in_stages_follows_the_damped_oscillator() -> None:
    assert effects.strong_viscosity(20) < 4e-3
    assert effects.creeping_viscosity(10) < 1.2e-2


def test_a_fall_under_tilted_gravity_is_exact() -> None:
    assert abs(effects.tilt(64)) < 1e-12


def test_a_lagging_grip_does_what_the_record_said_before() -> None:
    assert abs(effects.lag(91)) < 3.5e-4


def test_a_sagging_soft_beam_ends_where_finite_elements_put_it() -> None:
    assert peers.sag(10, across=2) < 0.025
