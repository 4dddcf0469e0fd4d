"""The three-phase speed profile: accelerate, cruise, decelerate, joined with C¹ speed.

v(t) = V·h(t/ta) while accelerating, V while cruising, V·h((D-t)/td) while decelerating, with
h(x) = 3x² - 2x³. h' vanishes at both ends, so the acceleration is continuous at every joint and zero at the
start and the end. The distance is closed: ∫₀^x h = x³ - x⁴/2, hence V·(D - ta/2 - td/2) in all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array

PEAK_SLOPE = 1.5  # max of h'


@dataclass(frozen=True)
class SpeedProfile:
    """A motion that starts and ends at rest.

    Attributes:
        duration_s: D.
        accelerate_s, decelerate_s: ta, td; their sum is at most D.
        cruise_m_s: V, the peak speed.
    """

    duration_s: float
    accelerate_s: float
    decelerate_s: float
    cruise_m_s: float

    def __post_init__(self) -> None:
        if min(self.accelerate_s, self.decelerate_s) <= 0.0 or self.cruise_m_s < 0.0:
            raise ValueError(
                f"ramps of {self.accelerate_s:g} s and {self.decelerate_s:g} s at {self.cruise_m_s:g} m/s: "
                "ramps must be positive and the speed not negative"
            )
        if self.accelerate_s + self.decelerate_s > self.duration_s * (1.0 + 1e-12):
            raise ValueError(
                f"ramps of {self.accelerate_s:g} s and {self.decelerate_s:g} s "
                f"do not fit in {self.duration_s:g} s"
            )

    @property
    def total_distance_m(self) -> float:
        """V·(D - ta/2 - td/2)."""
        return self.cruise_m_s * (self.duration_s - 0.5 * (self.accelerate_s + self.decelerate_s))

    def speed(self, t: Array) -> Array:
        """v(t) [m/s]; zero outside [0, D]."""
        rise, fall = self._phases(t)
        return self.cruise_m_s * np.minimum(_ramp(rise), _ramp(fall))

    def acceleration(self, t: Array) -> Array:
        """dv/dt [m/s²]."""
        rise, fall = self._phases(t)
        up = 6.0 * rise * (1.0 - rise) / self.accelerate_s
        down = 6.0 * fall * (1.0 - fall) / self.decelerate_s
        return self.cruise_m_s * (up - down)

    def distance(self, t: Array) -> Array:
        """∫₀ᵗ v [m], held at the total after the end."""
        t = np.clip(np.asarray(t, dtype=np.float64), 0.0, self.duration_s)
        rise, fall = self._phases(t)
        cruise = np.clip(t - self.accelerate_s, 0.0, self.duration_s - self.accelerate_s - self.decelerate_s)
        travelled = self.accelerate_s * _ramp_integral(rise) + cruise
        return self.cruise_m_s * (travelled + self.decelerate_s * (0.5 - _ramp_integral(fall)))

    def progress(self, t: Array) -> Array:
        """Normalised arc length s(t) = ∫₀ᵗ v / ∫₀ᴰ v in [0, 1]."""
        return np.clip(self.distance(t) / self.total_distance_m, 0.0, 1.0)

    def _phases(self, t: Array) -> tuple[Array, Array]:
        """Fractions of the two ramps that are done and still to come, each in [0, 1]."""
        t = np.asarray(t, dtype=np.float64)
        rise = np.clip(t / self.accelerate_s, 0.0, 1.0)
        fall = np.clip((self.duration_s - t) / self.decelerate_s, 0.0, 1.0)
        return rise, fall


@dataclass(frozen=True)
class ConstantSpeed:
    """Uniform motion without ramps: what VMP-Gen is compared with (paper, ablation of the motion pattern)."""

    duration_s: float

    def progress(self, t: Array) -> Array:
        """Share of the way, t/D in [0, 1]."""
        return np.clip(np.asarray(t, dtype=np.float64) / self.duration_s, 0.0, 1.0)


def profile_for(
    distance_m: float,
    peak_speed_m_s: float,
    *,
    accelerate_fraction: float = 0.3,
    decelerate_fraction: float = 0.3,
    min_ramp_s: float = 0.1,
    acceleration_limit_m_s2: float = np.inf,
) -> SpeedProfile:
    """The profile that covers ``distance_m`` in the given shape without passing any limit.

    The duration follows from distance, peak speed and the ramps' fractions of it; it is stretched (and the
    peak lowered with it) where a ramp would be shorter than ``min_ramp_s`` or pass the acceleration limit.

    Args:
        distance_m: to cover [m].
        peak_speed_m_s: that is not passed [m/s].
        accelerate_fraction, decelerate_fraction: of the duration, at most 1 together.
        min_ramp_s: shortest ramp [s].
        acceleration_limit_m_s2: that is not passed [m/s²].
    """
    if not (distance_m > 0.0 and peak_speed_m_s > 0.0):
        raise ValueError(f"a profile over {distance_m:g} m at {peak_speed_m_s:g} m/s: both must be positive")
    fractions = accelerate_fraction + decelerate_fraction
    shortest = min(accelerate_fraction, decelerate_fraction)
    if not (shortest > 0.0 and fractions <= 1.0):
        raise ValueError(f"ramp fractions {accelerate_fraction:g} and {decelerate_fraction:g}")
    mean_to_peak = 1.0 - 0.5 * fractions
    duration = max(
        distance_m / (peak_speed_m_s * mean_to_peak),
        min_ramp_s / shortest,
        float(np.sqrt(PEAK_SLOPE * distance_m / (mean_to_peak * shortest * acceleration_limit_m_s2))),
    )
    return SpeedProfile(
        duration_s=duration,
        accelerate_s=accelerate_fraction * duration,
        decelerate_s=decelerate_fraction * duration,
        cruise_m_s=distance_m / (duration * mean_to_peak),
    )


def _ramp(x: Array) -> Array:
    """h(x) = 3x² - 2x³ on [0, 1]."""
    return x * x * (3.0 - 2.0 * x)


def _ramp_integral(x: Array) -> Array:
    """∫₀ˣ h."""
    return x**3 * (1.0 - 0.5 * x)
