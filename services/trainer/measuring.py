"""What a version predicts of its recording, what that errs, and what it costs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.estimation.blocks import mean_with_interval
from physworld.evaluate.metrics import metrics
from physworld.evaluate.table import held_out_table
from physworld.worldmodel.clock import resample_smooth
from physworld.worldmodel.energy import still_energy
from physworld.worldmodel.errors import GraphInvalid
from physworld.worldmodel.holding.rollout import HeldVersions
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.scene_view import SceneView

SPEED_REPEATS = 3
RUNS = SPEED_REPEATS + 3
"""Parts of a measurement: timed rollouts, the calibrated one, the table, the energy."""


@dataclass(frozen=True)
class Measured:
    """Predictions of tracked points at the measured times (T, N, 3) [m], their table, steps per second, and the energy
    while the grips stand still."""

    tracks: Array
    tracks_calibrated: Array
    twin_tracks: Array
    vertices: Array
    table: dict[str, Any]
    steps_per_second: dict[str, float]
    energy: dict[str, Any]


def measure(
    view: SceneView,
    published: PublishedModel,
    before: PublishedModel | None = None,
    poll: Callable[[int, int], None] = lambda done, of: None,
    held: HeldVersions | None = None,
) -> Measured:
    """Open-loop predictions over the whole recording, and what they cost.

    A version for other grips than hold in the recording is not in the table: it predicts another motion. Where grips
    let go, versions for each set of them predict it together.

    Args:
        view: the recording at the model's vertices.
        published: the version.
        before: it without fine-tuned strengths; None: there are none.
        poll: called between rollouts with (done, of); it raises to end the measurement.
        held: the versions for every set of grips that holds in the recording; None: one holds all through, or some set
            has none.
    """
    controllers = view.controllers[view.first :]
    seconds = []
    for run in range(SPEED_REPEATS):
        poll(run, RUNS)
        started = time.perf_counter()
        rolled = published.rollout(controllers)
        seconds.append(time.perf_counter() - started)
    poll(SPEED_REPEATS, RUNS)
    calibrated = (before or published).rollout(controllers, phi=published.phi_calibrated)
    if held is not None and view.held is not None:
        try:
            rolled = calibrated = held.rollout(controllers, view.held[view.first :])
        except GraphInvalid:  # one of them left the numbers before another one takes over
            rolled = calibrated = np.full_like(rolled, np.nan)
    frame_times = view.scene.times - view.scene.times[0]
    tracks, tracks_calibrated = view.tracks_of(rolled), view.tracks_of(calibrated)
    twin_tracks = resample_smooth(view.twin_tracks, view.times, frame_times)
    predictions = {"twin": twin_tracks}
    if view.as_recorded or held is not None:
        predictions |= {"world_model": tracks_calibrated, "world_model_finetuned": tracks}
    finite = {name: path for name, path in predictions.items() if np.isfinite(path).all()}
    poll(SPEED_REPEATS + 1, RUNS)
    table = _with_intervals(held_out_table(view.scene, finite))
    poll(SPEED_REPEATS + 2, RUNS)
    return Measured(
        tracks=tracks,
        tracks_calibrated=tracks_calibrated,
        twin_tracks=twin_tracks,
        vertices=np.concatenate([np.repeat(view.vertices[:1], view.first, axis=0), rolled]),
        table=_with_absent(table, sorted(set(predictions) - set(finite))),
        steps_per_second={
            "twin": view.twin_steps_per_second,
            "world_model": (len(rolled) - view.history - 1) / min(seconds),
        },
        energy=still_energy(published, controllers),
    )


def json_safe(value: Any) -> Any:
    """Plain JSON types; a number that is not finite (a rollout that blew up) becomes None."""
    if isinstance(value, dict):
        return {str(key): json_safe(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_safe(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _with_intervals(table: dict[str, Any]) -> dict[str, Any]:
    """The table with ``ci95``: metric to name to the 95 % interval of the mean, by blocks of frames."""
    table["ci95"] = {
        metric: {
            name: list(mean_with_interval(np.array(curve, dtype=float)).ci95)
            for name, curve in table["per_frame"][metric].items()
            if any(value is not None for value in curve)
        }
        for metric in (metric.name for metric in metrics().values() if metric.listed)
    }
    return table


def _with_absent(table: dict[str, Any], absent: list[str]) -> dict[str, Any]:
    """The table with None for predictions that left the numbers: they have no error, and the rest is published."""
    for name in absent:
        for metric in metrics():
            table[metric][name] = None
    return table
