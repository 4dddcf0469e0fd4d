"""Intervals of refitted numbers, by resampling blocks of training frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.effects.registry import EFFECTS
from physworld.estimation.refit import Refit, prior_rows
from physworld.estimation.unknowns import at
from physworld.trace.hypotheses import Hypothesis
from physworld.trace.result import Named, Number
from physworld.twin.twin import Twin

_STEP = 0.01  # of an unknown's step: what it changes in a derived number
_TWO_SIDED = 1.96  # standard deviations of a 95 % interval


@dataclass(frozen=True)
class Spread:
    """How well an optimum is known.

    Attributes:
        fitted: the optimum.
        drawn: unknowns under resampled blocks of frames, (resamples, p).
        covariance: what sensitivities leave of it, a sighting counting what it counts, (p, p).
    """

    fitted: Refit
    drawn: Array
    covariance: Array

    def numbers(self) -> dict[str, Number]:
        """Every unknown's value and interval.

        The interval is that of the linear refit under resampled blocks of frames, but no narrower than the
        sensitivities and the noise leave it: few blocks, or a single one, resample to much the same.
        """
        fitted, found = self.fitted, {}
        least = _TWO_SIDED * np.sqrt(np.diag(self.covariance))
        for k, unknown in enumerate(fitted.unknowns):
            value = unknown.value(float(fitted.theta[k]))
            below, above = np.quantile(self.drawn[:, k], [0.025, 0.975])
            ends = min(below, fitted.theta[k] - least[k]), max(above, fitted.theta[k] + least[k])
            low, high = sorted(unknown.value(float(np.clip(end, *unknown.bounds))) for end in ends)
            found[unknown.name] = Number(value, unknown.unit, (low, high))
        return found

    def derived(self, name: str) -> dict[str, Number]:
        """What an effect's numbers imply, with intervals to first order (the delta method)."""
        fitted, unknowns = self.fitted, self.fitted.unknowns
        implied = _implied(fitted.twin, name)
        slopes: dict[str, Array] = {key: np.zeros(len(unknowns)) for key in implied}
        for k, unknown in enumerate(unknowns):
            step = np.zeros(len(unknowns))
            step[k] = _STEP * unknown.step * (1.0 if fitted.theta[k] < unknown.bounds[1] else -1.0)
            there = _implied(at(fitted.twin, unknowns, fitted.theta + step), name)
            for key, (value, _) in implied.items():
                slopes[key][k] = (there.get(key, (value, ""))[0] - value) / step[k]
        found = {}
        for key, (value, unit) in implied.items():
            slope = slopes[key]
            resampled = (self.drawn - fitted.theta) @ slope
            reach = _TWO_SIDED * float(np.sqrt(slope @ self.covariance @ slope))
            below, above = np.quantile(resampled, [0.025, 0.975])
            ends = (min(below, -reach), max(above, reach))
            found[key] = Number(value, unit, (value + float(ends[0]), value + float(ends[1])))
        return found


def spread_of(model: Hypothesis, blocks: Sequence[Array], resamples: int, seed: int) -> Spread:
    """How well an optimum is known, by resampling blocks of training frames, and by what a sighting counts.

    Args:
        model: with its errors on left-out blocks.
        blocks: rows of every block of frames.
        resamples: of the blocks.
        seed: of these.
    """
    fitted, scale = model.fitted, model.unseen.scale
    residual, jacobian = fitted.residual / scale, fitted.jacobian / scale
    normal = np.stack([jacobian[own].T @ jacobian[own] for own in blocks])
    gradient = np.stack([jacobian[own].T @ residual[own] for own in blocks])
    prior_residual, prior_slope = prior_rows(fitted.unknowns, fitted.theta)
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(len(blocks), np.full(len(blocks), 1.0 / len(blocks)), size=resamples)
    ridge = 1e-9 * np.diag(np.diag(normal.sum(axis=0)) + 1e-30)
    covariance = np.linalg.inv(normal.sum(axis=0) + prior_slope.T @ prior_slope + ridge)
    total = np.tensordot(counts, normal, 1) + prior_slope.T @ prior_slope + ridge
    push = np.tensordot(counts, gradient, 1) + prior_slope.T @ prior_residual
    drawn = fitted.theta + np.linalg.solve(total, push[..., None])[..., 0]
    # with few blocks the resampled optimum may miss the slope that the tolerance of the search left: centre it
    drawn += fitted.theta - np.median(drawn, axis=0)
    return Spread(fitted, drawn, covariance)


def named(model: Hypothesis, spread: Spread) -> tuple[Named, ...]:
    """The effects of a model with their numbers: what was estimated, and what that implies."""
    found, estimated, twin = [], spread.numbers(), model.fitted.twin
    effects = {known.name: known for known in twin.effects}
    for name in model.names:
        own = {k.split(".", 1)[1]: n for k, n in estimated.items() if k.startswith(f"{name}.")}
        shown = effects.get(name, EFFECTS[name]()).placed(twin)
        for key, value in shown.values.items():
            if key not in own and value is not None and key not in shown.gates and value != 0.0:
                unit = next((s.unit for s in shown.strengths(twin) if s.name == key), "m")
                own[key] = Number(float(value), unit)
        found.append(Named(name, own | spread.derived(name)))
    return tuple(found)


def _implied(twin: Twin, name: str) -> dict[str, tuple[float, str]]:
    known = next((e for e in twin.effects if e.name == name), None) or EFFECTS[name]()
    return known.placed(twin).derived(twin)


def calibrated(estimated: dict[str, Number]) -> dict[str, Number]:
    """The numbers that belong to no effect."""
    return {name: number for name, number in estimated.items() if "." not in name}
