"""The three-phase speed profile: closed distance, continuous acceleration, limits kept."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physworld.demonstrate.speed_profile import SpeedProfile, profile_for

PROFILE = SpeedProfile(duration_s=2.0, accelerate_s=0.4, decelerate_s=0.7, cruise_m_s=0.5)


def peak_acceleration(profile: SpeedProfile) -> float:
    """1.5 times the cruise speed over the shorter ramp [m/s²]."""
    return 1.5 * profile.cruise_m_s / min(profile.accelerate_s, profile.decelerate_s)


def test_speed_rises_cruises_and_falls():
    assert PROFILE.speed(np.array(0.0)) == 0.0
    assert PROFILE.speed(np.array(2.0)) == 0.0
    np.testing.assert_allclose(PROFILE.speed(np.linspace(0.4, 1.3, 9)), 0.5)
    assert np.all(np.diff(PROFILE.speed(np.linspace(0.0, 0.4, 30))) > 0.0)
    assert np.all(np.diff(PROFILE.speed(np.linspace(1.3, 2.0, 30))) < 0.0)


def test_the_closed_distance_is_the_integral_of_the_speed():
    t = np.linspace(0.0, 2.0, 20_001)
    v = PROFILE.speed(t)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
    np.testing.assert_allclose(PROFILE.distance(t), integral, atol=1e-8)  # trapezoid rule at 0.1 ms
    assert PROFILE.total_distance_m == pytest.approx(0.5 * (2.0 - 0.2 - 0.35))
    assert float(PROFILE.distance(np.array(9.0))) == pytest.approx(PROFILE.total_distance_m)
    assert float(PROFILE.progress(np.array(2.0))) == pytest.approx(1.0)


def test_acceleration_is_the_derivative_of_speed_and_has_no_jump_at_the_joints():
    t, step = np.linspace(0.001, 1.999, 777), 1e-6
    np.testing.assert_allclose(
        PROFILE.acceleration(t), (PROFILE.speed(t + step) - PROFILE.speed(t - step)) / (2 * step), atol=1e-5
    )
    for joint in (0.0, 0.4, 1.3, 2.0):
        around = PROFILE.acceleration(np.array([joint - 1e-9, joint, joint + 1e-9]))
        assert np.ptp(around) < 1e-6
        assert abs(around[1]) < 1e-12
    assert np.abs(PROFILE.acceleration(np.linspace(0, 2, 5001))).max() == pytest.approx(
        peak_acceleration(PROFILE), rel=1e-4
    )


@given(
    distance=st.floats(1e-3, 5.0),
    peak=st.floats(1e-2, 3.0),
    rise=st.floats(0.05, 0.5),
    fall=st.floats(0.05, 0.5),
    acceleration=st.floats(0.1, 100.0),
)
def test_a_profile_covers_its_distance_within_its_limits(distance, peak, rise, fall, acceleration):
    profile = profile_for(
        distance,
        peak,
        accelerate_fraction=rise,
        decelerate_fraction=fall,
        min_ramp_s=0.05,
        acceleration_limit_m_s2=acceleration,
    )
    slack = 1.0 + 1e-9
    assert profile.total_distance_m == pytest.approx(distance, rel=1e-9)
    assert profile.cruise_m_s <= peak * slack
    assert peak_acceleration(profile) <= acceleration * slack
    assert min(profile.accelerate_s, profile.decelerate_s) * slack >= 0.05


def test_impossible_profiles_are_refused_with_their_numbers():
    with pytest.raises(ValueError, match=r"1\.5 s and 1 s do not fit in 2 s"):
        SpeedProfile(2.0, 1.5, 1.0, 1.0)
    with pytest.raises(ValueError, match=r"over 0 m"):
        profile_for(0.0, 1.0)
