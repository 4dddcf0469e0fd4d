"""The results table on a scene's held-out frames: every prediction beside every baseline.

All figures in SI units, over the frames ``scene.test`` (frame 0 is never scored: every prediction starts from it). The
table is plain JSON: a value that does not exist (nothing was seen) is None, never NaN.
"""

from __future__ import annotations

import math
from typing import Any

from physworld.arrays import Array
from physworld.evaluate.baselines import BASELINES
from physworld.evaluate.metrics import metrics, noise_floor
from physworld.scene import Scene


def held_out_table(scene: Scene, predictions: dict[str, Array]) -> dict[str, Any]:
    """Errors of the baselines and of ``predictions`` (name to (T, N, 3) positions [m]) on the test frames.

    Returns:
        Every metric of :func:`physworld.evaluate.metrics.metrics`: name of the prediction to its value;
        ``per_frame``: ``frames``, ``times_s`` and the listed metrics as curves over the test frames, the error
        against the horizon; ``noise_floor_m``: what a perfect prediction would show in ``track_m``, None when
        the noise is not declared; ``frames``: the scored half-open range.
    """
    taken = sorted(set(predictions) & set(BASELINES))
    if taken:
        raise ValueError(f"the baselines compute {', '.join(taken)} themselves")
    everything = {name: baseline(scene) for name, baseline in BASELINES.items()} | predictions
    for name, predicted in everything.items():
        if predicted.shape != scene.points.shape:
            raise ValueError(f"{name} has shape {predicted.shape}, the scene's points {scene.points.shape}")
    first, last = max(scene.test[0], 1), scene.test[1]
    if last <= first:
        raise ValueError(f"the scene holds out no frame: test {scene.test}")
    window = slice(first, last)
    curves = {
        metric: {
            name: metric.per_frame(predicted[window], scene.points[window], scene.visible[window])
            for name, predicted in everything.items()
        }
        for metric in metrics().values()
    }
    table: dict[str, Any] = {
        metric.name: {name: _json_number(metric.mean(curve)) for name, curve in by_name.items()}
        for metric, by_name in curves.items()
    }
    table["noise_floor_m"] = None if scene.noise_sigma_m is None else noise_floor(scene.noise_sigma_m)
    table["frames"] = [first, last]
    table["per_frame"] = {
        "frames": list(range(first, last)),
        "times_s": [float(t) for t in scene.times[window]],
        **{
            metric.name: {name: [_json_number(e) for e in curve] for name, curve in by_name.items()}
            for metric, by_name in curves.items()
            if metric.listed
        },
    }
    return table


def _json_number(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
