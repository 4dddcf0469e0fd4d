"""Intervals of refitted numbers, by resampling blocks of training frames."""

from __future__ import annotations

import numpy as np

from physworld.effects.registry import EFFECTS
from physworld.trace.confirm import Model
from physworld.trace.refit import Refit, prior_rows
from physworld.trace.result import Named, Number

_TWO_SIDED = 1.96  # standard deviations of a 95 % interval


def numbers(
    fitted: Refit, block_of_row: np.ndarray, finer: dict[str, float], resamples: int, seed: int
) -> dict[str, Number]:
    """Every unknown's value and interval.

    The interval is that of the linear refit under resampled blocks of frames, but no narrower than the sensitivities
    and the noise (the misfit, where that is larger) leave it: few blocks, or a single one, resample to much the same.
    It is widened to hold the value that was found at the second resolution.

    Args:
        finer: values at the second resolution, by name.
    """
    blocks = int(block_of_row.max()) + 1
    normal = np.zeros((blocks, len(fitted.theta), len(fitted.theta)))
    gradient = np.zeros((blocks, len(fitted.theta)))
    for block in range(blocks):
        rows = block_of_row == block
        normal[block] = fitted.jacobian[rows].T @ fitted.jacobian[rows]
        gradient[block] = fitted.jacobian[rows].T @ fitted.residual[rows]
    prior_residual, prior_slope = prior_rows(fitted.unknowns, fitted.theta)
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), size=resamples)
    ridge = 1e-9 * np.diag(np.diag(normal.sum(axis=0)) + 1e-30)
    information = normal.sum(axis=0) + prior_slope.T @ prior_slope + ridge
    least = _TWO_SIDED * max(1.0, fitted.misfit) * np.sqrt(np.diag(np.linalg.inv(information)))
    total = np.tensordot(counts, normal, 1) + prior_slope.T @ prior_slope + ridge
    push = np.tensordot(counts, gradient, 1) + prior_slope.T @ prior_residual
    drawn = fitted.theta + np.linalg.solve(total, push[..., None])[..., 0]
    # with few blocks the resampled optimum may miss the slope that the tolerance of the search left: centre it
    drawn += fitted.theta - np.median(drawn, axis=0)
    found = {}
    for k, unknown in enumerate(fitted.unknowns):
        value = unknown.value(float(fitted.theta[k]))
        below, above = np.quantile(drawn[:, k], [0.025, 0.975])
        ends = min(below, fitted.theta[k] - least[k]), max(above, fitted.theta[k] + least[k])
        low, high = sorted(unknown.value(float(np.clip(end, unknown.low, unknown.high))) for end in ends)
        other = finer.get(unknown.name, value)
        found[unknown.name] = Number(value, unknown.unit, (min(low, other), max(high, other)))
    return found


def named(model: Model, estimated: dict[str, Number]) -> tuple[Named, ...]:
    """The effects of a model with their numbers: what was estimated, and what that implies."""
    found = []
    effects = {known.name: known for known in model.fitted.twin.effects}
    for name in model.names:
        own = {k.split(".", 1)[1]: n for k, n in estimated.items() if k.startswith(f"{name}.")}
        shown = effects.get(name, EFFECTS[name]()).placed(model.fitted.twin)
        for key, value in shown.values.items():
            if key not in own and value is not None and key not in shown.gates and value != 0.0:
                unit = next((s.unit for s in shown.strengths(model.fitted.twin) if s.name == key), "m")
                own[key] = Number(float(value), unit)
        own |= {key: Number(value, unit) for key, (value, unit) in shown.derived.items()}
        found.append(Named(name, own))
    return tuple(found)


def calibrated(estimated: dict[str, Number]) -> dict[str, Number]:
    """The numbers that belong to no effect."""
    return {name: number for name, number in estimated.items() if "." not in name}
