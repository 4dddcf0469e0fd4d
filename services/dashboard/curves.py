"""Curves over time for the charts: a prediction's error per frame, curves that a result brought along."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld_schemas.model import ModelComparison

if TYPE_CHECKING:
    from physworld.scene import Scene

MOST_TIMES = 1500
LABELS = {
    "static": ("Static", "static"),
    "rigid_follow": ("Rigid follow", "rigid"),
    "constant_velocity": ("Constant velocity", "velocity"),
    "before": ("Before", "other"),
    "after": ("After", "predicted"),
    "twin_homogeneous": ("Twin without its field", "other"),
    "twin": ("Twin", "predicted"),
    "world_model": ("World model", "other"),
    "world_model_finetuned": ("World model, fine-tuned", "model"),
}
PREDICTORS = ("after", "twin_homogeneous", "twin", "world_model", "world_model_finetuned")
TIMES_KEY = "times_s"


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
    times: Array, errors: Mapping[str, Array], *, split: float | None, x_label: str = "time [s]"
) -> dict[str, object]:
    """The JSON that ``frontend/src/curve.js`` draws: error curves [m] in millimetres over ``times`` [s]."""
    stride = max(1, -(-len(times) // MOST_TIMES))
    return {
        "x": {"label": x_label},
        "y": {"label": "mean error [mm]", "unit": "mm"},
        "times": _rounded(times[::stride]),
        "split": split,
        "series": [
            {
                "label": LABELS.get(name, (name.replace("_", " "), "other"))[0],
                "role": LABELS.get(name, (name, "other"))[1],
                "bold": name in PREDICTORS,
                "values": _rounded(np.asarray(values)[::stride] * 1000),
            }
            for name, values in errors.items()
        ],
    }


def comparison_chart(found: ModelComparison) -> dict[str, object]:
    """Curves of two versions over the times of the first; what only the scene decides (baselines) is drawn once."""
    times = np.array(found.curves_a.times_s, dtype=float)
    errors: dict[str, Array] = {}
    drawn = chart(times, errors, split=None)
    series = []
    for number, curves, roles in (
        (found.a, found.curves_a, {"twin": "rigid", "world_model_finetuned": "other"}),
        (found.b, found.curves_b, {"twin": "predicted", "world_model_finetuned": "model"}),
    ):
        for name, values in curves.track_m.items():
            if name not in roles or len(values) != len(curves.times_s) or len(values) < 2:
                continue
            given = np.array([math.nan if value is None else value for value in values], dtype=float)
            label = f"{LABELS[name][0]}, version {number}"
            placed = onto(np.array(curves.times_s, dtype=float), given, times)
            one = chart(times, {name: placed}, split=None)["series"]
            series += [{**item, "label": label, "role": roles[name]} for item in one]  # type: ignore[attr-defined]
    return {**drawn, "series": series}


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
            if name in LABELS and isinstance(values, Sequence) and len(values) == len(times)
        }
        if len(times) > 1 and errors:
            return times, errors
    return None


def onto(times: Array, values: Array, target: Array) -> Array:
    """``values`` given at ``times`` on the ``target`` times, NaN outside of them."""
    return np.interp(target, times, values, left=math.nan, right=math.nan)


def _rounded(values: Array) -> list[float | None]:
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in values]
