"""What the card of a model says of the trace that its twin went through.

Which effects were added, with their strengths and intervals, or why none was; the held-out track error of
the twin without and with them, and of the world models that learned from the one and from the other. "Before" of the
twin is the fit's own, with the damping that it may have added; of the world model it is the version that learned from
that twin with the same settings, where there is one. A trace also calibrates anew: ``twin.recalibrated_m`` is the error
of the declared physics alone after that, so that nobody takes its part for the effect's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.estimation.blocks import mean_with_interval, paired_gain
from physworld.evaluate.metrics import track_error_per_frame
from physworld.scene import Scene
from physworld.twin.twin import Twin
from physworld.worldmodel.clock import resample_smooth
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.scene_view import view_scene
from physworld_schemas.trace import Trace
from physworld_storage import registry, traces
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import npz_arrays, scene_of, twin_of

METRIC = "track_m"
WORLD_MODEL = "world_model_finetuned"


def closed_loop(
    stores: Stores, payload: dict[str, Any], metrics: Mapping[str, Any], architecture: WorldModelConfig
) -> dict[str, Any] | None:
    """The section of the card; None where the dataset's twin went through no trace.

    Args:
        payload: of the training shard.
        metrics: of the version that is being made; ``held_out`` is the table of :mod:`physworld.evaluate.table`.
        architecture: of the model: both twins are measured on its clock.
    """
    if payload.get("trace_id") is None:
        return None
    with stores.database.reading() as session:
        trace = traces.get_trace(session, payload["trace_id"])
        number = payload.get("baseline")
        baseline = None if number is None else registry.get_version(session, payload["name"], number)
    added = traces.leaves_twin(trace)
    section: dict[str, Any] = {
        "trace_id": trace.id,
        "verdict": trace.verdict,
        "reason": trace.reason,
        "statement": statement(trace),
        "effects_added": [effect.model_dump(mode="json") for effect in trace.effects] if added else [],
        "trace_held_out": trace.held_out,
        "unexplained": trace.unexplained,
        "metric": f"held_out.{METRIC}",
        "noise_floor_m": metrics.get("noise_floor_m"),
    }
    if not added:
        return section
    scene = scene_of(stores, payload["scene_id"])
    plain = _twin_errors(scene, twin_of(stores, payload["fit_id"]), architecture)
    section["twin"] = before_and_after(plain, _curve(metrics, "twin"))
    declared = _declared_twin(stores, trace)
    if declared is not None:
        alone = mean_with_interval(_twin_errors(scene, declared, architecture))
        section["twin"] |= {"recalibrated_m": alone.value, "recalibrated_ci95_m": list(alone.ci95)}
    before = None if baseline is None else _curve(baseline.metrics, WORLD_MODEL)
    section["world_model"] = before_and_after(before, _curve(metrics, WORLD_MODEL))
    section["baseline_version"] = None if baseline is None else baseline.version
    return section


def statement(trace: Trace) -> str:
    """One sentence for people."""
    if traces.leaves_twin(trace):
        found = []
        for effect in trace.effects:
            strengths = [_figure(name, value.model_dump()) for name, value in effect.parameters.items()]
            found.append(f"{effect.name} ({', '.join(strengths)})")
        known = "" if trace.verdict == "named" else ", the best of a set that these data cannot tell apart"
        return f"The twin carries {' and '.join(found)}{known}: {trace.reason}"
    return f"Nothing was added to the twin, the verdict is {trace.verdict}: {trace.reason}"


def before_and_after(before: Array | None, after: Array | None) -> dict[str, Any]:
    """Means of two error curves over the same frames (F,) [m], and the gain with its interval by paired blocks."""
    found: dict[str, Any] = {"before_m": None, "after_m": None, "gain_m": None, "gain_ci95_m": None}
    for name, curve in (("before_m", before), ("after_m", after)):
        if curve is not None:
            mean = mean_with_interval(curve)
            found[name], found[f"{name.removesuffix('_m')}_ci95_m"] = mean.value, list(mean.ci95)
    if before is not None and after is not None and len(before) == len(after):
        gain = paired_gain(before, after)
        found["gain_m"], found["gain_ci95_m"] = gain.value, list(gain.ci95)
    return found


def _curve(metrics: Mapping[str, Any], name: str) -> Array | None:
    """The error per held-out frame of a table, None where the table has none."""
    curves = metrics.get("held_out", {}).get("per_frame", {}).get(METRIC, {})
    if name not in curves:
        return None
    curve = np.array([np.nan if value is None else value for value in curves[name]], dtype=float)
    return curve if np.isfinite(curve).any() else None


def _declared_twin(stores: Stores, trace: Trace) -> Twin | None:
    """The declared physics alone as the trace calibrated it."""
    found = next((item for item in trace.artifacts if item.name == traces.DECLARED), None)
    if found is None:
        return None
    return Twin.from_arrays(npz_arrays(stores.artifacts.read_bytes(found.sha256)), stores.settings.device)


def _twin_errors(scene: Scene, twin: Twin, architecture: WorldModelConfig) -> Array:
    """Error of a twin per held-out frame [m], by the same way as the table of a version."""
    view = view_scene(scene, twin, architecture)
    tracks = resample_smooth(view.twin_tracks, view.times, scene.times - scene.times[0])
    window = slice(max(scene.test[0], 1), scene.test[1])
    return track_error_per_frame(tracks[window], scene.points[window], scene.visible[window])


def _figure(name: str, number: dict[str, Any]) -> str:
    value, interval = number["value"], number["ci95"]
    text = f"{name} {value:.4g} {number['unit']}" if value is not None else name
    if interval and None not in interval:
        text += f", 95 % {interval[0]:.4g} to {interval[1]:.4g}"
    return text
