"""Left-out errors against refits of the rows, and what sightings count."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from physworld.estimation.left_out import LeftOut, Linear, independent, left_out
from physworld.estimation.unknowns import Unknown

BLOCKS, ROWS = 5, 12


def linear_fit(
    jacobian: np.ndarray, observed: np.ndarray, bounds: tuple[float, float], scale: float
) -> Linear:
    """The fit of three unknowns with priors (0, 2) within the bounds, where a sighting counts ``scale``."""
    rows = np.concatenate([jacobian / scale, np.eye(3) / 2.0])
    wanted = np.concatenate([observed / scale, np.zeros(3)])
    found = lsq_linear(rows, wanted, bounds, method="trf", tol=1e-14, max_iter=500).x
    unknowns = [Unknown(f"u{k}", "1", *bounds, lambda twin, v: twin, prior=(0.0, 2.0)) for k in range(3)]
    return Linear(observed - jacobian @ found, jacobian, unknowns, found)


@pytest.mark.parametrize("bounds", [(-50.0, 50.0), (-0.3, 0.3)])
@pytest.mark.parametrize("scale", [1.0, 8.0])
def test_a_left_out_block_is_predicted_by_a_fit_to_the_others(
    bounds: tuple[float, float], scale: float
) -> None:
    rng = np.random.default_rng(3)
    block_of_row = np.repeat(np.arange(BLOCKS), ROWS)
    jacobian = rng.normal(size=(BLOCKS * ROWS, 3))
    # the third number is seen in one block only, where the others make up for it
    jacobian[:, 2] = np.where(block_of_row == 2, jacobian[:, 0] + jacobian[:, 1], 0.01 * jacobian[:, 2])
    observed = jacobian @ np.array([0.2, -0.1, 0.25]) + rng.normal(size=BLOCKS * ROWS)
    fitted = linear_fit(jacobian, observed, bounds, scale)
    found = left_out(fitted, [np.flatnonzero(block_of_row == k) for k in range(BLOCKS)], scale)
    for block in range(BLOCKS):
        kept = block_of_row != block
        alone = linear_fit(jacobian[kept], observed[kept], bounds, scale)
        left = observed[~kept] - jacobian[~kept] @ alone.theta
        assert found.errors[block] == pytest.approx(np.mean(left**2), rel=1e-4)


def test_between_hypotheses_an_error_that_may_hide_in_the_noise_counts() -> None:
    exact, wrong = (LeftOut(np.full(6, error), np.full(6, 100)) for error in (1.0, 40.0))
    assert exact.count == pytest.approx(1.0 / ((1 / 1.2) ** 2 / 600 + (0.2 / 1.2) ** 2 / 6))
    assert exact.scale == pytest.approx(1.0)  # intervals and priors take the noise as it is
    assert 6.0 < wrong.count < 6.5


@pytest.mark.parametrize("shared", [0.0, 0.3, 3.0])
def test_sightings_are_worth_what_the_spread_of_their_mean_square_says(shared: float) -> None:
    """Noise in every number, and an error that all numbers of a block share: the mean square of n independent numbers
    of deviation 1 spreads by sqrt(2 / n)."""
    rng = np.random.default_rng(0)
    rows, blocks, draws = 600, 12, 4000
    noise = rng.normal(size=(draws, rows))
    common = np.sqrt(shared) * np.repeat(rng.normal(size=(draws, blocks)), rows // blocks, axis=1)
    signs = np.where(np.arange(rows) % 2, 1.0, -1.0)  # a pattern within the block
    parts = np.mean(noise**2, axis=1) + np.mean((signs * common) ** 2, axis=1)
    worth = 2.0 * np.mean(parts) ** 2 / np.var(parts)
    assert independent(1.0 + shared, rows, blocks) == pytest.approx(worth, rel=0.1)
