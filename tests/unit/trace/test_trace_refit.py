"""Refits: from given sensitivities, which the steps correct, the optimum is found without simulating any."""

from __future__ import annotations

import numpy as np
import pytest
from modelled_bar import Bar
from sagging_bar import TRUE_PA

from physworld.effects.registry import effect
from physworld.estimation.refit import Refit, refit

DRAG_PER_S, FAR_PA = 3.0, 6.5e4


@pytest.fixture(scope="module")
def bar() -> Bar:
    return Bar(effect("air_drag_linear", rate_per_s=DRAG_PER_S))


def test_steps_correct_the_sensitivities_they_began_with(bar: Bar) -> None:
    far = bar.model("air_drag_linear", FAR_PA, rate_per_s=1.0).fitted
    wrong = far.jacobian * [0.6, 1.7]  # of the stiffness, of the drag
    runs = bar.simulations.count
    found = again(bar, far, wrong, 6)
    assert bar.simulations.count - runs <= 1 + 6 * 2  # where it begins, and two places a step
    assert found.misfit < 1.1 < 3.0 < far.misfit
    assert found.value("youngs_modulus_pa") == pytest.approx(TRUE_PA, rel=0.01)
    assert found.value("air_drag_linear.rate_per_s") == pytest.approx(DRAG_PER_S, rel=0.1)
    asked = again(bar, found, None, 1).jacobian
    for own, true, first in zip(found.jacobian.T, asked.T, wrong.T, strict=True):
        assert np.linalg.norm(own - true) < 0.5 * np.linalg.norm(first - true)


def again(bar: Bar, start: Refit, jacobian: np.ndarray | None, iterations: int) -> Refit:
    found = refit(
        bar.simulations, bar.white, start.twin, start.unknowns, bar.frames, iterations, jacobian=jacobian
    )
    assert found is not None
    return found
