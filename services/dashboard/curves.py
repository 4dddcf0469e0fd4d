"""What the plots of the pages show: a prediction's error per frame, curves that a result brought along, versions side
by side, a training under way. All are drawn by ``physworld.report.svg``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld.report.markup import Html
from physworld.report.predictors import NOISE, PREDICTORS
from physworld.report.svg import DWARFS, Interval, Series, dwarfed, interval_chart, line_chart
from physworld_schemas.loop import Loop
from physworld_schemas.model import ModelVersion
from physworld_services.dashboard.tables import held_out_of

if TYPE_CHECKING:
    from physworld.scene import Scene

MOST_TIMES = 600
TIMES_KEY = "times_s"
MM = 1e3
NARROW_PX = 320.0
"""Width of a plot in a small window, about that of a phone."""
VERSION_DASHES = (None, "7 3", "2 3", "9 3 2 3", "1 4", "12 4")
"""One colour is one predictor's; versions that are compared differ in their dash."""
METRIC = "track_m"
LONGEST_NAME = 18
"""Characters of a recording's name in the label of a row."""
FEWEST = 2
"""Points that make a line."""


def frame_errors(scene: Scene, tracks: Array) -> Array:
    """Mean distance of predicted ``tracks`` (T, N, 3) [m] to the visible measured points, (T,) [m].

    NaN in a frame where nothing was visible.
    """
    distances = np.linalg.norm(tracks - scene.points, axis=2)
    valid = scene.visible & np.isfinite(distances)
    seen = valid.sum(axis=1)
    total = np.where(valid, distances, 0.0).sum(axis=1)
    return np.where(seen > 0, total / np.maximum(seen, 1), np.nan)


def chart(
    times: Array, errors: Mapping[str, Array], *, split: float | None = None, floor_m: float | None = None
) -> Html:
    """Error curves [m] in millimetres over ``times`` [s], with the noise floor; logarithmic where baselines dwarf them.

    Args:
        times: (T,) [s].
        errors: (T,) [m] by predictor.
        split: where the held-out frames begin [s].
        floor_m: mean error of a perfect prediction under the declared noise [m]; None: not known.
    """
    picked = slice(None, None, max(1, -(-len(times) // MOST_TIMES)))
    series = [
        Series(one.label, one.role, _mm(errors[name][picked]), 1.4 if one.baseline else 2.2, one.dash)
        for name, one in PREDICTORS.items()
        if name in errors
    ]
    return _drawn(times[picked], series, split, floor_m)


def comparison_chart(versions: Sequence[ModelVersion], floor_m: float | None) -> Html | None:
    """Curves of versions over the times of the first, each predictor in its colour, each version with its dash.

    None where none of them has curves.
    """
    series: list[Series] = []
    times = np.empty(0)
    for version, dash in zip(versions, VERSION_DASHES, strict=False):
        given = given_curves(version.metrics)
        if given is None:
            continue
        times = times if len(times) else given[0]
        for name in ("twin", "world_model_finetuned"):
            if name in given[1]:
                one = PREDICTORS[name]
                label = f"{one.label}, version {version.version}"
                values = onto(given[0], given[1][name], times)
                series.append(Series(label, one.role, _mm(values), 2.2, dash))
    return _drawn(times, series, None, floor_m) if series else None


def versions_chart(versions: Sequence[ModelVersion], floor_m: float | None) -> Html | None:
    """Mean held-out track errors of versions with their intervals, a row each and predictor; None without any."""
    rows = []
    for name in ("twin", "world_model", "world_model_finetuned"):
        one = PREDICTORS[name]
        for version in versions:
            table: Mapping[str, Any] = held_out_of(version.metrics) or {}
            value = table.get(METRIC, {}).get(name)
            if value is None:
                continue
            ends = table.get("ci95", {}).get(METRIC, {}).get(name)
            scaled = None if ends is None else (MM * ends[0], MM * ends[1])
            rows.append(Interval(f"{one.label}, version {version.version}", one.role, MM * value, scaled))
    if not rows:
        return None
    values = [row.value for row in rows if row.value > 0]
    return interval_chart(
        rows,
        title="Mean track errors of the versions with 95 % intervals",
        x_label="mean held-out track error [mm], 95 % interval",
        floor=None if floor_m is None else MM * floor_m,
        log_x=bool(values) and max(values) > DWARFS * min(values),
        width=980,
        narrow=NARROW_PX,
    )


def turns_chart(turns: Sequence[Loop], names: Mapping[str, str]) -> Html | None:
    """Errors of the versions before and after each loop with their intervals, oldest first; None without any.

    Args:
        turns: loops of one model, newest first.
        names: of their recordings, by id.
    """
    rows = []
    for turn in reversed(turns):
        recording = names.get(turn.scene_id, turn.scene_id)[:LONGEST_NAME]
        for one, role in ((turn.before, "before"), (turn.after, "after")):
            if one is not None:
                low, high = one.measured.ci95_m
                label = f"{recording}, version {one.version}"
                rows.append(Interval(label, role, MM * one.measured.error_m, (MM * low, MM * high)))
    if not rows:
        return None
    values = [row.value for row in rows if row.value > 0]
    return interval_chart(
        rows,
        title="Errors of the versions before and after each loop",
        x_label="mean track error on held-out frames of the new recording [mm], 95 % interval",
        log_x=bool(values) and max(values) > DWARFS * min(values),
        width=980,
    )


def training_charts(points: Sequence[tuple[float, Mapping[str, float]]]) -> list[Html]:
    """Loss and validation of a training over its steps, as far as it has come; empty before there are two of one.

    Args:
        points: (step, figures) as the job told them: ``loss``, ``validation_m``.
    """
    charts = []
    for name, label, role, scale, unit in (
        ("loss", "training loss / prior's", "calibrated", 1.0, ""),
        ("validation_m", "validation error [mm]", "model", MM, "mm"),
    ):
        told = {step: scale * figures[name] for step, figures in points if name in figures}
        if len(told) < FEWEST:
            continue
        steps = sorted(told)[:: max(1, len(told) // MOST_TIMES)]
        line = Series(label, role, [told[step] for step in steps])
        values = [value for value in told.values() if value > 0]
        charts.append(
            line_chart(
                steps,
                [line],
                title=label,
                x_label="step",
                y_label=label,
                log_y=bool(values) and max(values) > DWARFS * min(values),
                height=220,
                width=520,
                narrow=NARROW_PX,
                unit=unit,
            )
        )
    return charts


def split_time(recording: Scene) -> float | None:
    """When the held-out frames begin [s], None where none are held out."""
    first, last = recording.test
    return float(recording.times[first]) if first < last else None


def given_curves(metrics: Mapping[str, Any]) -> tuple[Array, dict[str, Array]] | None:
    """The curves of the track error that a result stored: times (T,) [s], errors (T,) [m] by predictor.

    They are looked for in ``held_out.per_frame`` (what the library's ``held_out_table`` makes), ``per_frame``
    and ``curves``; None where there are none.
    """
    table = metrics.get("held_out")
    nested = table.get("per_frame") if isinstance(table, Mapping) else None
    for curves in (nested, metrics.get("per_frame"), metrics.get("curves")):
        if not isinstance(curves, Mapping) or not isinstance(curves.get(TIMES_KEY), Sequence):
            continue
        times = np.array(curves[TIMES_KEY], dtype=float)
        by_name = curves.get("track_m", curves)
        errors = {
            str(name): np.array(values, dtype=float)
            for name, values in by_name.items()
            if name in PREDICTORS and isinstance(values, Sequence) and len(values) == len(times)
        }
        if len(times) > 1 and errors:
            return times, errors
    return None


def onto(times: Array, values: Array, target: Array) -> Array:
    """``values`` given at ``times`` on the ``target`` times, NaN outside of them."""
    return np.interp(target, times, values, left=math.nan, right=math.nan)


def _drawn(times: Array, series: list[Series], split: float | None, floor_m: float | None) -> Html:
    if floor_m is not None:
        series = [*series, Series("noise floor", NOISE, [MM * floor_m] * len(times), 1.6, "3 3")]
    return line_chart(
        times.tolist(),
        series,
        title="Mean error against time",
        x_label="time [s]",
        y_label="mean error [mm]",
        split=split,
        log_y=dwarfed(series),
        height=300,
        width=980,
        narrow=NARROW_PX,
        unit="mm",
    )


def _mm(values: Array) -> list[float]:
    return [float(value) for value in MM * np.asarray(values, dtype=float)]
