"""The energy of a rollout with still grips, against closed forms."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from physworld.worldmodel.energy import QUARTERS, STILL_TICKS, kinetic_energy, still_energy
from physworld.worldmodel.published import PublishedModel
from physworld_schemas.quality import quality_of

DT_S = 1.0 / 30.0
RATE = 9.0  # rad/s


@dataclass
class Swing:
    """A body of two vertices that swings by sin(RATE t) e^(growth t), whatever its grips do."""

    growth: float

    @property
    def spec(self) -> SimpleNamespace:
        return SimpleNamespace(dt_s=DT_S)

    def rollout(self, controllers: np.ndarray) -> np.ndarray:
        times = DT_S * np.arange(len(controllers))
        with np.errstate(over="ignore", invalid="ignore"):
            along = 0.01 * np.sin(RATE * times) * np.exp(self.growth * times)
            return along[:, None, None] * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def measured(growth: float) -> dict[str, object]:
    still = np.zeros((60, 1, 3))
    return {"energy": still_energy(cast(PublishedModel, Swing(growth)), still)}


def test_kinetic_energy_of_a_steady_motion() -> None:
    path = np.arange(4)[:, None, None] * np.array([[0.03, 0.0, 0.04], [0.0, 0.0, 0.0]])
    assert kinetic_energy(path, 0.1) == pytest.approx(np.full(3, 0.5 * 0.5**2 / 2.0))


@pytest.mark.parametrize(("growth", "verdict"), [(0.0, "passed"), (-0.5, "passed"), (0.3, "failed")])
def test_a_swing_is_judged_by_whether_it_grows(growth: float, verdict: str) -> None:
    assert quality_of(measured(growth)).verdict == verdict


def test_quarters_are_means_over_the_time_with_still_grips() -> None:
    energy = still_energy(cast(PublishedModel, Swing(0.3)), np.zeros((60, 1, 3)))
    quarters = energy["still_quarters_m2_s2"]
    assert (energy["still_ticks"], len(quarters)) == (STILL_TICKS, QUARTERS)
    ratio = np.exp(2.0 * 0.3 * DT_S * STILL_TICKS / QUARTERS)  # e grows by the square of the amplitude
    assert np.divide(quarters[1:], quarters[:-1]) == pytest.approx(np.full(QUARTERS - 1, ratio), rel=0.05)


def test_a_rollout_that_leaves_the_numbers_is_told() -> None:
    (reason,) = quality_of(measured(200.0)).reasons
    assert "left the numbers while" in reason
