"""Refits: the optimum is found from sensitivities that steps correct, and has its own at the end."""

from __future__ import annotations

import numpy as np
import pytest
from modelled_bar import Bar
from sagging_bar import TRUE_PA

from physworld.effects.registry import effect
from physworld.estimation.refit import refit

DRAG_PER_S, FAR_PA = 3.0, 6.5e4


@pytest.fixture(scope="module")
def bar() -> Bar:
    return Bar(effect("air_drag_linear", rate_per_s=DRAG_PER_S))


def test_steps_correct_the_sensitivities_they_began_with(bar: Bar) -> None:
    """A run for each unknown is only spent where the steps do not pay, and at the end."""
    far = bar.model("air_drag_linear", FAR_PA, rate_per_s=1.0)
    wrong = far.jacobian * [0.6, 1.7]  # of the stiffness, of the drag
    runs = bar.simulations.count
    found = refit(bar.simulations, bar.white, far.twin, far.unknowns, bar.frames, 8, jacobian=wrong)
    assert found is not None and found.misfit < 1.1 < 3.0 < far.misfit
    assert bar.simulations.count - runs < 1 + 8 * (2 + 2)
    assert found.value("youngs_modulus_pa") == pytest.approx(TRUE_PA, rel=0.01)
    assert found.value("air_drag_linear.rate_per_s") == pytest.approx(DRAG_PER_S, rel=0.1)


def test_an_optimum_has_the_sensitivities_that_simulations_give(bar: Bar) -> None:
    far = bar.model("air_drag_linear", FAR_PA, rate_per_s=1.0)
    found = refit(bar.simulations, bar.white, far.twin, far.unknowns, bar.frames, 8)
    assert found is not None
    there = bar.model(
        "air_drag_linear",
        found.value("youngs_modulus_pa"),
        rate_per_s=found.value("air_drag_linear.rate_per_s"),
    )
    for own, true in zip(found.jacobian.T, there.jacobian.T, strict=True):
        assert np.linalg.norm(own - true) < 0.03 * np.linalg.norm(true)
