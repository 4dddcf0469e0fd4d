"""Two versions of a model side by side: their errors on the held-out frames, and what differs in how they were made.

Means carry 95 % intervals by blocks of neighbouring frames, and the gain of one version over the other is taken frame
by frame where both were scored on the same frames of the same recording (``physworld.estimation.blocks``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld_schemas.library import catalogue
from physworld_schemas.model import (
    ComparedError,
    Difference,
    ErrorCurves,
    MeasuredError,
    ModelComparison,
    ModelVersion,
)
from physworld_storage.errors import Conflict

FIGURES = (
    "steps_per_second.world_model",
    "steps_per_second.twin",
    "seconds.training",
    "seconds.fine_tuning",
    "episodes",
    "noise_floor_m",
    "validation.open_loop_m",
    "validation.prior_m",
    "validation.best_step",
    "world_model_against_twin_m",
)
MADE_FROM = ("scene_id", "fit_id", "trace_id", "dataset_id")


def compare_versions(a: ModelVersion, b: ModelVersion) -> ModelComparison:
    """The comparison of two ready versions. Raises Conflict when one is not ready."""
    for version in (a, b):
        if version.state != "ready":
            raise Conflict(
                f"version {version.version} of {version.name} is {version.state}; a comparison needs ready versions"
            )
    same = a.scene_id == b.scene_id and _frames(a) is not None and _frames(a) == _frames(b)
    return ModelComparison(
        name=a.name,
        a=a.version,
        b=b.version,
        same_recording=same,
        errors=list(_errors(a, b, same)),
        figures=[
            Difference(field=field, a=_at(a.metrics, field), b=_at(b.metrics, field)) for field in FIGURES
        ],
        curves_a=_curves(a),
        curves_b=_curves(b),
        differences=_differences(a, b),
    )


def _errors(a: ModelVersion, b: ModelVersion, same: bool) -> Iterator[ComparedError]:
    tables = [_table(version) for version in (a, b)]
    for listed in catalogue().listed_metrics():
        metric = listed.name
        predictors = dict.fromkeys(name for table in tables for name in table.get(metric, {}))
        for predictor in predictors:
            curves = [_curve(table, metric, predictor) for table in tables]
            means = [
                _mean(table, metric, predictor, curve) for table, curve in zip(tables, curves, strict=True)
            ]
            yield ComparedError(
                metric=metric,
                predictor=predictor,
                a=means[0],
                b=means[1],
                gain=_gain(*(curves if listed.lower_is_better else reversed(curves))) if same else None,
            )


def _mean(table: Mapping[str, Any], metric: str, predictor: str, curve: Array | None) -> MeasuredError | None:
    value = table.get(metric, {}).get(predictor)
    if value is None:
        return None
    if curve is None or not np.isfinite(curve).any():
        return MeasuredError(value=value)
    # scipy, which the web process loads when it is asked for
    from physworld.estimation.blocks import mean_with_interval

    return MeasuredError(value=value, ci95=mean_with_interval(curve).ci95)


def _gain(a: Array | None, b: Array | None) -> MeasuredError | None:
    if a is None or b is None or not np.isfinite(a - b).any():
        return None
    from physworld.estimation.blocks import paired_gain

    gain = paired_gain(a, b)
    return MeasuredError(value=gain.value, ci95=gain.ci95)


def _differences(a: ModelVersion, b: ModelVersion) -> list[Difference]:
    """Settings, inputs and code that are not the same; the job and the moment always differ and say nothing."""
    found = [
        Difference(field=f"config.{field}", a=getattr(a.config, field), b=getattr(b.config, field))
        for field in type(a.config).model_fields
    ]
    found += [Difference(field=field, a=getattr(a, field), b=getattr(b, field)) for field in MADE_FROM]
    inputs = [{item.kind: item.digest for item in version.lineage.inputs} for version in (a, b)]
    found += [
        Difference(field=f"lineage.{kind}.digest", a=inputs[0].get(kind), b=inputs[1].get(kind))
        for kind in dict.fromkeys([*inputs[0], *inputs[1]])
    ]
    found += [
        Difference(field=f"lineage.{field}", a=getattr(a.lineage, field), b=getattr(b.lineage, field))
        for field in ("code_version", "device")
    ]
    return [item for item in found if item.a != item.b]


def _curves(version: ModelVersion) -> ErrorCurves:
    per_frame = _table(version).get("per_frame", {})
    return ErrorCurves(times_s=per_frame.get("times_s", []), track_m=per_frame.get("track_m", {}))


def _curve(table: Mapping[str, Any], metric: str, predictor: str) -> Array | None:
    curve = table.get("per_frame", {}).get(metric, {}).get(predictor)
    if curve is None:
        return None
    return np.array([np.nan if value is None else value for value in curve], dtype=float)


def _frames(version: ModelVersion) -> Any:
    return _table(version).get("frames")


def _table(version: ModelVersion) -> Mapping[str, Any]:
    found = version.metrics.get("held_out")
    return found if isinstance(found, Mapping) else {}


def _at(values: Mapping[str, Any], path: str) -> Any:
    """The value at a dotted path, None where there is none."""
    found: Any = values
    for key in path.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found
