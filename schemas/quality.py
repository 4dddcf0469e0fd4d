"""Whether a world model's version is good enough to be served as ``latest``: a verdict with its reasons and numbers.

It is computed from the version's metrics, so that it holds for versions that were published before there was a gate.
A version fails where, open loop on the frames that were held out of its recording, it

* left the numbers, or has no error where the baselines have one;
* errs more than standing still, or than following the grips rigidly. Where such a baseline errs less than the
  measurement's noise, the noise is the limit: below it nothing can be told apart;
* gains energy without end while its grips stand still. Elastic bodies lose energy then, or keep it. ``energy`` of the
  metrics has the mean kinetic energy per mass of the object's vertices over the four quarters of that time
  (``physworld.worldmodel.energy``): it fails if the last quarter is the largest, ``GROWTH`` times the first, and above
  ``QUIET_SHARE`` of the largest energy while the grips moved.

Without figures to judge by, the verdict is ``unknown``, which is no failure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from pydantic import Field

from physworld_schemas.base import Resource
from physworld_schemas.library import catalogue

GROWTH = 2.0
QUIET_SHARE = 0.01
WITH_NOISE = "track_m"  # the metric that the noise floor is of
PREDICTORS = ("world_model_finetuned", "world_model")
BASELINES = {"static": "standing still", "rigid_follow": "following the grips rigidly"}


class Quality(Resource):
    """The verdict on a version.

    ``metric``: by which it was judged; ``model_m`` and ``baselines_m``: mean held-out errors [m]; ``noise_floor_m``:
    what a perfect prediction would show [m]; ``energy_growth``: kinetic energy in the last quarter of the time with
    still grips, over that in the first.
    """

    verdict: Literal["passed", "failed", "unknown"] = Field(
        default="unknown", description="Whether it is good enough to become `latest`; unknown counts as good."
    )
    reasons: list[str] = Field(default_factory=list, description="Why it failed, each with its numbers.")
    metric: str | None = Field(
        default=None,
        description="Metric by which its errors were judged; null: by none.",
        examples=["track_m"],
    )
    model_m: float | None = Field(
        default=None,
        description="Its mean held-out error; null: it left the numbers, or was not judged.",
        json_schema_extra={"unit": "m"},
    )
    baselines_m: dict[str, float] = Field(
        default_factory=dict,
        description="Mean held-out errors of the baselines, by name.",
        json_schema_extra={"unit": "m"},
    )
    noise_floor_m: float | None = Field(
        default=None,
        description="What a perfect prediction would show; null: the noise is not declared.",
        json_schema_extra={"unit": "m"},
    )
    energy_growth: float | None = Field(
        default=None,
        description="Kinetic energy in the last quarter of the time with still grips over that in the first.",
        json_schema_extra={"unit": "1"},
    )


def quality_of(metrics: Mapping[str, Any]) -> Quality:
    """The verdict on a version with these metrics; see the module's text."""
    quality = Quality()
    judged = _judge_errors(quality, metrics.get("held_out"))
    judged |= _judge_energy(quality, metrics.get("energy"))
    if judged:
        quality.verdict = "failed" if quality.reasons else "passed"
    return quality


def _judge_errors(quality: Quality, table: Any) -> bool:
    """Fill in the errors; false where there is nothing to compare."""
    if not isinstance(table, Mapping):
        return False
    for metric in (one.name for one in catalogue().listed_metrics() if one.unit == "m"):
        errors = table.get(metric)
        if not isinstance(errors, Mapping):
            continue
        baselines = {name: _number(errors.get(name)) for name in BASELINES}
        found = {name: value for name, value in baselines.items() if value is not None}
        predictor = next((name for name in PREDICTORS if name in errors), None)
        if not found or predictor is None:
            continue
        floor = _number(table.get("noise_floor_m")) if metric == WITH_NOISE else None
        model = _number(errors[predictor])
        quality.metric, quality.model_m, quality.baselines_m = metric, model, found
        quality.noise_floor_m = floor
        if model is None:
            quality.reasons.append("its open-loop prediction of the held-out frames left the numbers")
            return True
        for name, value in found.items():
            if model > max(value, floor or 0.0):
                quality.reasons.append(
                    f"it errs {_millimetres(model)} on the held-out frames, {BASELINES[name]} "
                    f"{_millimetres(value)}"
                )
        return True
    return False


def _judge_energy(quality: Quality, energy: Any) -> bool:
    """Fill in the growth of the energy under still grips; false where it was not measured."""
    quarters = energy.get("still_quarters_m2_s2") if isinstance(energy, Mapping) else None
    if not isinstance(quarters, Sequence) or len(quarters) < 2:
        return False
    values = [_number(value) for value in quarters]
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        quality.reasons.append("its prediction left the numbers while the grips stood still")
        return True
    first, last = known[0], known[-1]
    quality.energy_growth = last / first if first > 0.0 else None
    peak = _number(energy.get("moving_peak_m2_s2")) or 0.0
    if last >= max(known) and last > GROWTH * first and last > QUIET_SHARE * peak:
        quality.reasons.append(
            f"its energy grows while the grips stand still: {last:.3g} m²/s² a mass in the last quarter of that time, "
            f"{first:.3g} in the first"
        )
    return True


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def _millimetres(value: float) -> str:
    return f"{1e3 * value:.3g} mm"
