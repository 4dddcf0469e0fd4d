"""What a calibration says: every number with its interval, whether data fix it, what was held and why; its losses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.parameters import Parameter
from physworld.estimation.least_squares import Solution, block_covariance, correlations, interval_factor
from physworld.estimation.uncertain import moved_by
from physworld.evaluate.metrics import chamfer_l2
from physworld.scene import Scene
from physworld.twin.twin import Twin

UNIDENTIFIED_HALF_WIDTH = {"log": 1.5, "linear": 0.25}
"""Half width of a 95 % interval, in the scale of the search, beyond which the data do not fix a value."""

_EDGE = 0.01  # closer than this to a bound, in the scale of the search, is at it

NOT_MEASURED = "its sensitivity was not measured: no run beside the optimum could be used"
MOVING = "the search had not converged on it"
NOT_CONVERGED = (NOT_MEASURED, MOVING)
"""Notes of a number on which the search did not converge, or cannot say so."""

RATIO_NOTE = "only stiffness over density shows in the motion under gravity, ground and prescribed grips"


@dataclass(frozen=True)
class Estimate:
    """A calibrated number: value, unit, 95 % interval (None where none can be given), and whether data fix it."""

    value: float
    unit: str
    ci95: tuple[float, float] | None = None
    identified: bool = True
    note: str = ""


@dataclass(frozen=True)
class Correlations:
    """Correlations of the searched parameters: names (p) and matrix (p, p)."""

    names: tuple[str, ...]
    matrix: Array


def estimates(
    parameters: list[Parameter],
    solution: Solution,
    frames: Array,
    points: Array,
    measured: bool,
    changes: list[Array] | None = None,
) -> tuple[dict[str, Estimate], Correlations]:
    """Estimates and correlations of the searched parameters.

    Args:
        parameters: what was searched.
        solution: the optimum with its sensitivities.
        frames, points: frame and tracked point of every residual, (m,).
        measured: the sensitivities were measured; without them no interval is given.
        changes: of the residual (m,), one standard deviation each, by what errs for the whole recording.
    """
    covariance = block_covariance(solution, frames, points) + moved_by(solution.jacobian, changes or [])
    factor = interval_factor(len(np.unique(frames)), len(parameters)) if measured else float("inf")
    due = np.abs(np.linalg.lstsq(solution.jacobian, -solution.residual, rcond=None)[0])
    found = {}
    for k, parameter in enumerate(parameters):
        theta, value = float(solution.theta[k]), parameter.value(float(solution.theta[k]))
        half = factor * float(np.sqrt(covariance[k, k])) if covariance[k, k] > 0 else float("inf")
        insensitive = not measured or not np.any(solution.jacobian[:, k])
        low, high = parameter.bounds
        at_bound = not (low + _EDGE < theta < high - _EDGE)
        moving = bool(due[k] > max(half, parameter.step))
        identified = half < UNIDENTIFIED_HALF_WIDTH[parameter.transform.name] and not (
            at_bound or insensitive or moving
        )
        note = "" if identified else _why_not(at_bound, insensitive, moving)
        ends = (
            (parameter.value(theta - min(half, 50.0)), parameter.value(theta + min(half, 50.0)))
            if np.isfinite(half)
            else None
        )
        found[parameter.name] = Estimate(value, parameter.unit, ends, identified, note)
    return found, Correlations(tuple(p.name for p in parameters), correlations(covariance))


def cut_short(found: dict[str, Estimate], simulations: int) -> dict[str, Estimate]:
    """The estimates of a search that did not end by itself: no interval, nothing identified.

    An interval says how far an optimum may be off; where the budget ended the search, nobody knows how far that is.
    """
    note = f"the search was cut short by its budget of {simulations} simulations: the best found so far, no interval"
    return {name: replace(known, ci95=None, identified=False, note=note) for name, known in found.items()}


def held_at_priors(
    scene: Scene, twin: Twin, rejected: dict[str, float], parameters: list[Parameter]
) -> dict[str, Estimate]:
    """What was held: the density (only ratios to it show), what the data did not ask for, and a rod's stretch.

    Args:
        rejected: share of the training cost that freeing each of them removes.
        parameters: all that could be searched.
    """
    unit = {3: "kg/m^3", 2: "kg/m^2", 1: "kg/m"}[twin.lattice.dim]
    declared = scene.body.density_kg_m3 is not None or scene.body.mass_kg is not None
    held = {
        "density": Estimate(
            twin.density, unit, None, False, f"{'as declared' if declared else 'prior'}; {RATIO_NOTE}"
        )
    }
    values = twin.parameters
    if "stretching_n" in values:
        note = "held: stiff enough to stretch by less than a percent"
        held["stretching_n"] = Estimate(values["stretching_n"], "N", None, False, note)
    by_name = {parameter.name: parameter for parameter in parameters}
    for name, gain in rejected.items():
        value = values.get(name, by_name[name].held)
        share = (
            f"freeing it removes {max(gain, 0.0):.1%} of the training cost"
            if np.isfinite(gain)
            else "not tried to its end"
        )
        needless = not value or name == "yield_stress_pa"  # nothing reaches the prior of a yield stress
        kept = "not needed" if needless else "held at its prior"
        held[name] = Estimate(value, by_name[name].unit, None, False, f"{kept}: {share}")
    for name in ("poissons_ratio", "ground_friction", "self_friction"):
        if name in values and name not in held:
            held[name] = Estimate(values[name], "1", None, False, "held at its prior")
    return held


def _why_not(at_bound: bool, insensitive: bool, moving: bool) -> str:
    if insensitive:
        return NOT_MEASURED
    if at_bound:
        return "at the bound of its search"
    return MOVING if moving else "the data do not fix it"


CHAMFER_WEIGHT, TRACK_WEIGHT = 1.0, 0.1


def training_losses(scene: Scene, tracks: Array) -> dict[str, Any]:
    """Losses of predicted tracks (T, N, 3) on the training frames, frame 0 left out.

    Returns:
        ``paper``: ``total``, ``chamfer_m``, ``track_smooth_l1``; ``rms_m``: root mean squared coordinate error;
        ``noise_sigma_m``, ``chi2_per_residual`` and ``rms_over_noise``, None where no noise is declared.
    """
    window = slice(max(scene.train[0], 1), scene.train[1])
    visible, measured, predicted = scene.visible[window], scene.points[window], tracks[window]
    error = (predicted - measured)[visible]
    size = np.abs(error)
    smooth = np.where(size < 1.0, 0.5 * error**2, size - 0.5)
    chamfer = chamfer_l2(predicted, measured, visible)
    track = float(smooth.sum() / (3 * max(len(error), 1)))
    square = float(np.mean(error**2))
    weighed = float(np.mean(scene.weighed(predicted - measured)[visible] ** 2))
    sigma = scene.noise_sigma_m
    return {
        "paper": {
            "total": CHAMFER_WEIGHT * chamfer + TRACK_WEIGHT * track,
            "chamfer_m": chamfer,
            "track_smooth_l1": track,
        },
        "rms_m": float(np.sqrt(square)),
        "noise_sigma_m": sigma,
        "chi2_per_residual": weighed / sigma**2 if sigma else None,
        "rms_over_noise": float(np.sqrt(weighed)) / sigma if sigma else None,
    }
