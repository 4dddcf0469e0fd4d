"""Leave-one-block-out errors of a refit, against fits of the rows themselves."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from physworld.estimation.refit import Refit
from physworld.estimation.unknowns import Unknown
from physworld.trace.comparison import CrossValidation, better_beyond_chance, cross_validated, difference

BLOCKS, ROWS = 5, 12


def unknown(name: str, low: float, high: float) -> Unknown:
    return Unknown(name, "1", low, high, lambda twin, value: twin, step=0.1)


def refit(jacobian: np.ndarray, observed: np.ndarray, bounds: list[tuple[float, float]]) -> Refit:
    """The linear fit within the bounds, as a refit leaves it."""
    low, high = np.transpose(bounds)
    found = lsq_linear(jacobian, observed, (low, high), method="trf", tol=1e-14, max_iter=500)
    unknowns = [unknown(f"u{k}", *ends) for k, ends in enumerate(bounds)]
    twin = SimpleNamespace()
    return Refit(unknowns, twin, found.x, np.zeros((1, 1, 3)), observed - jacobian @ found.x, jacobian)


@pytest.mark.parametrize("bounds", [(-50.0, 50.0), (-0.3, 0.3)])
def test_a_left_out_block_is_predicted_by_a_fit_within_the_bounds(bounds: tuple[float, float]) -> None:
    rng = np.random.default_rng(3)
    block_of_row = np.repeat(np.arange(BLOCKS), ROWS)
    jacobian = rng.normal(size=(BLOCKS * ROWS, 3))
    # the third number is seen in one block only, where the others make up for it
    jacobian[:, 2] = np.where(block_of_row == 2, jacobian[:, 0] + jacobian[:, 1], 0.01 * jacobian[:, 2])
    observed = jacobian @ np.array([0.2, -0.1, 0.25]) + rng.normal(size=BLOCKS * ROWS)
    fitted = refit(jacobian, observed, [bounds] * 3)
    found = cross_validated(fitted, block_of_row)
    for block in range(BLOCKS):
        kept = block_of_row != block
        alone = refit(jacobian[kept], observed[kept], [bounds] * 3)
        left = observed[~kept] - jacobian[~kept] @ alone.theta
        assert found.errors[block] == pytest.approx(np.mean(left**2), rel=1e-4)


def test_what_a_left_out_block_alone_shows_does_not_blow_up_its_error() -> None:
    """Clipping a free step instead leaves the other unknown where it made up for what was cut off."""
    block_of_row = np.repeat([0, 1], 50)
    rng = np.random.default_rng(0)
    shown = rng.normal(size=100)
    jacobian = np.stack(
        [shown, np.where(block_of_row == 0, rng.normal(size=100), shown + 1e-3 * rng.normal(size=100))],
        axis=1,
    )
    observed = shown + rng.normal(size=100)
    found = cross_validated(refit(jacobian, observed, [(-5.0, 5.0), (-0.5, 0.5)]), block_of_row)
    assert found.errors.max() < 1.6


def blocks(*errors: float) -> CrossValidation:
    return CrossValidation(np.array(errors), np.full(len(errors), 30))


def test_an_effect_that_grows_over_time_is_beyond_chance() -> None:
    """Its differences spread as widely as the effect does; in every block the error is a share of what it was."""
    before, after = blocks(1.1, 1.6, 2.5, 3.5, 5.5, 16.0), blocks(1.0, 1.1, 0.9, 1.2, 1.0, 1.1)
    gain, spread = difference(before, after)
    assert gain < 2.0 * spread
    assert better_beyond_chance(after, before)
    assert not better_beyond_chance(before, after)


def test_a_gain_in_one_block_only_is_within_chance() -> None:
    assert not better_beyond_chance(
        blocks(1.0, 1.02, 0.98, 1.1, 1.0, 1.0), blocks(1.0, 1.0, 1.0, 1.05, 1.0, 9.0)
    )


def test_a_smaller_error_in_most_blocks_is_no_gain_where_the_whole_is_worse() -> None:
    assert not better_beyond_chance(
        blocks(0.5, 0.5, 0.5, 0.5, 0.5, 9.0), blocks(1.0, 1.0, 1.0, 1.0, 1.0, 6.0)
    )


def test_one_block_tells_nothing() -> None:
    assert not better_beyond_chance(blocks(1.0), blocks(9.0))
