"""The results table on a scene's held-out frames: every prediction beside every baseline.

All figures in metres, over the frames ``scene.test`` (frame 0 is never scored: every prediction starts from
it). The table is plain JSON: a value that does not exist (nothing was seen) is None, never NaN.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.evaluate.baselines import BASELINES
from physworld.evaluate.metrics import (
    chamfer_l2_per_frame,
    chamfer_phystwin_per_frame,
    mean_over_frames,
    noise_floor,
    track_error_per_frame,
)
from physworld.scene import Scene

PER_FRAME_METRICS = {
    "track_m": track_error_per_frame,
    "chamfer_phystwin_m": chamfer_phystwin_per_frame,
    "chamfer_l2_m": chamfer_l2_per_frame,
}


def held_out_table(scene: Scene, predictions: dict[str, Array]) -> dict[str, Any]:
    """Errors of the baselines and of ``predictions`` (name to (T, N, 3) positions [m]) on the test frames.

    Returns:
        ``track_m``, ``track_phystwin_m``, ``chamfer_phystwin_m``, ``chamfer_l2_m``: name to error [m];
        ``per_frame``: ``frames``, ``times_s`` and the same metrics as curves over the test frames, the error
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
            name: per_frame(predicted[window], scene.points[window], scene.visible[window])
            for name, predicted in everything.items()
        }
        for metric, per_frame in PER_FRAME_METRICS.items()
    }
    table: dict[str, Any] = {
        metric: {name: _json_number(mean_over_frames(curve)) for name, curve in by_name.items()}
        for metric, by_name in curves.items()
    }
    table["track_phystwin_m"] = {
        name: float(np.nan_to_num(curve, nan=0.0).mean()) for name, curve in curves["track_m"].items()
    }
    table["noise_floor_m"] = None if scene.noise_sigma_m is None else noise_floor(scene.noise_sigma_m)
    table["frames"] = [first, last]
    table["per_frame"] = {
        "frames": list(range(first, last)),
        "times_s": [float(t) for t in scene.times[window]],
        **{
            metric: {name: [_json_number(e) for e in curve] for name, curve in by_name.items()}
            for metric, by_name in curves.items()
        },
    }
    return table


def _json_number(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
