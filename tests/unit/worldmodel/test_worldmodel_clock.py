"""The model's clock."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.worldmodel.clock import clock_times, model_dt, resample, resample_smooth


@pytest.mark.parametrize(
    ("fps", "dt"),
    [(30.0, 1 / 30), (100.0, 0.03), (125.0, 0.032), (9.2, 1 / 30), (44.0, 1 / 44), (60.0, 1 / 30)],
)
def test_a_step_is_a_whole_number_of_frames_near_a_thirtieth(fps: float, dt: float) -> None:
    assert model_dt(fps) == pytest.approx(dt)


@pytest.mark.parametrize("fps", [0.0, -3.0, float("nan")])
def test_a_frame_rate_that_is_none_is_refused(fps: float) -> None:
    with pytest.raises(ValueError, match="frame rate"):
        model_dt(fps)


def test_ticks_cover_the_recording() -> None:
    assert clock_times(1.0, 0.03)[-1] == pytest.approx(1.02)
    assert clock_times(0.9, 0.03)[-1] == pytest.approx(0.9)


def test_interpolation_keeps_measured_values_and_straight_lines() -> None:
    times = np.array([0.0, 0.1, 0.25, 0.3])
    line = np.stack([2.0 * times, 1.0 - times], axis=1)
    between = np.array([0.05, 0.1, 0.2, 0.3])
    for interpolate in (resample, resample_smooth):
        assert interpolate(line, times, between)[:, 0] == pytest.approx(2.0 * between)
        assert interpolate(line, times, np.array([-1.0, 9.0]))[:, 1] == pytest.approx([1.0, 0.7])


def test_a_swing_of_four_hertz_survives_the_clock() -> None:
    ticks, frames = np.arange(0.0, 2.0, 0.03), np.arange(0.3, 1.5, 0.01)
    swing = np.sin(2.0 * np.pi * 4.0 * ticks)
    error = np.abs(resample_smooth(swing, ticks, frames) - np.sin(2.0 * np.pi * 4.0 * frames)).max()
    assert error < 0.02 < np.abs(resample(swing, ticks, frames) - np.sin(2 * np.pi * 4.0 * frames)).max()


def test_times_that_stand_still_are_refused() -> None:
    with pytest.raises(ValueError, match="strictly"):
        resample(np.zeros(2), np.array([0.0, 0.0]), np.array([0.0]))
