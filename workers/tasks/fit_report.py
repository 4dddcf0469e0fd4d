"""What a fit leaves behind, the same for the service's task and for ``physworld fit``: figures and files.

Files: ``twin.npz`` (the twin, see ``Twin.to_arrays``), ``prediction.npz`` (``times`` (T,) f8 [s], ``tracks``
(T, N, 3) f4 [m], ``particles`` (T, P', 3) f4 [m] with P' at most 1500, ``particle_indices`` (P',)),
``report.json`` (parameters, metrics, notes). Of several recordings these are the first one's; the twin and the
prediction of the k-th are ``twin_k.npz`` and ``prediction_k.npz``, k from 2.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.calibrate import Estimate, FitResult
from physworld.calibrate.law_choice import LawChoice
from physworld.calibrate.local_search import FIELDS
from physworld.calibrate.local_stage import LocalResult
from physworld.calibrate.recordings import Agreement, Recorded
from physworld.evaluate.table import held_out_table
from physworld.scene import Scene
from physworld_schemas.fit import Parameter
from physworld_workers.tasks.inputs import TWIN, npz_bytes

PREDICTION = "prediction.npz"
REPORT = "report.json"
SHOWN_PARTICLES = 1500


def media_type(name: str) -> str:
    """Of a file of a fit."""
    return "application/json" if name == REPORT else "application/x-npz"


def fit_report(
    scene: Scene, fitted: FitResult, law: LawChoice | None, accuracy: dict[str, Any]
) -> dict[str, Any]:
    """``parameters``, ``metrics`` and ``notes`` as plain JSON; a number that is not finite is None.

    Args:
        scene: the recording, of several the first.
        fitted: its calibration.
        law: how the law was chosen; None: it is the usual one.
        accuracy: of :func:`physworld_workers.tasks.fit_accuracy.fit_accuracy`.
    """
    law = law or LawChoice(fitted.twin.law.name)
    open_ones = {**fitted.open, **({} if law.ended else {"law": law.reason})}
    metrics = {
        "held_out": held_out_table(scene, _predictors(fitted)),
        "simulations": fitted.simulations,
        "seconds": fitted.seconds,
        "training_loss_m": fitted.loss_history,
        "not_needed": fitted.rejected,
        "particles": fitted.particles.shape[1],
        "correlations": {
            "names": list(fitted.correlations.names),
            "matrix": fitted.correlations.matrix,
        },
        "training": fitted.losses,
        "law": asdict(law),
        "formulation": {"name": fitted.twin.formulation, "reason": _formulation_reason(fitted)},
        "local": _local_record(fitted.local),
        "search": {"converged": not open_ones, "open": open_ones},
        "recordings": [_of_recording(known) for known in fitted.recordings],
        "agreement": [_agreement(known, fitted.recordings) for known in fitted.agreement],
        **accuracy,
    }
    return {
        "parameters": {name: parameter_json(estimate) for name, estimate in fitted.parameters.items()},
        "metrics": json_safe(metrics),
        "notes": list(fitted.twin.body.notes),
    }


def fit_files(scene: Scene, fitted: FitResult, report: dict[str, Any]) -> dict[str, bytes]:
    """The files by name, the twin first."""
    found = {
        TWIN: npz_bytes(fitted.twin.to_arrays()),
        PREDICTION: _prediction(scene, fitted),
        REPORT: json.dumps(report, indent=1, allow_nan=False).encode(),
    }
    for number, known in enumerate(fitted.recordings[1:], 2):
        found[TWIN.replace(".", f"_{number}.")] = npz_bytes(known.twin.to_arrays())
        found[PREDICTION.replace(".", f"_{number}.")] = _prediction(known.scene, known)
    return found


def _prediction(scene: Scene, predicted: FitResult | Recorded) -> bytes:
    count = predicted.particles.shape[1]
    shown = np.unique(np.linspace(0, count - 1, min(count, SHOWN_PARTICLES)).round().astype(np.int64))
    return npz_bytes(
        {
            "times": scene.times,
            "tracks": predicted.tracks.astype(np.float32),
            "particles": predicted.particles[:, shown].astype(np.float32),
            "particle_indices": shown,
        }
    )


def _of_recording(known: Recorded) -> dict[str, Any]:
    """Errors of one of several recordings, without the curves."""
    held_out = held_out_table(known.scene, {"twin": known.tracks})
    del held_out["per_frame"]
    return {"scene": known.scene.name, "held_out": held_out, "training": known.losses}


def _agreement(known: Agreement, recordings: Sequence[Recorded]) -> dict[str, Any]:
    """How far the own optimum of every recording lies off the common one."""
    each = zip(recordings, known.own, known.shifts, strict=True)
    return {
        "parameter": known.name,
        "unit": known.unit,
        "value": known.value,
        "agrees": known.agrees,
        "recordings": [
            {"scene": one.scene.name, "value": own, "shift_in_deviations": shift} for one, own, shift in each
        ],
    }


def json_safe(value: Any) -> Any:
    """Plain JSON types; a number that is not finite becomes None (a run that blew up has no loss)."""
    if isinstance(value, dict):
        return {str(key): json_safe(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [json_safe(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _predictors(fitted: FitResult) -> dict[str, Array]:
    """Tracks whose errors are reported: the twin's, and where it carries a field also those without it."""
    found = {"twin": fitted.tracks}
    return found if fitted.homogeneous is None else {"twin_homogeneous": fitted.homogeneous, **found}


def _local_record(local: LocalResult | None) -> dict[str, Any] | None:
    """What the local stage found, without its arrays: the field itself is the twin's."""
    if local is None:
        return None
    columns = {name: local.properties[:, FIELDS.index(name)] for name in local.fields}
    return {
        "kept": local.kept,
        "reason": local.reason,
        "held": local.held,
        "strength": local.strength,
        "validation": {f"{strength:g}": ratio for strength, ratio in local.validation.items()},
        "log_factors": {
            name: {"mean": values.mean(), "low": values.min(), "high": values.max()}
            for name, values in columns.items()
        },
        "runs": local.runs,
        "simulations": local.simulations,
        "seconds": local.seconds,
    }


def _formulation_reason(fitted: FitResult) -> str:
    """The note in which the body says why it is integrated that way."""
    start = fitted.twin.form.title
    return next((note for note in fitted.twin.body.notes if note.startswith(start)), "")


def parameter_json(estimate: Estimate) -> dict[str, Any]:
    """An estimate in the wire's form."""
    interval = estimate.ci95
    if interval is not None and not all(math.isfinite(end) for end in interval):
        interval = None
    parameter = Parameter(
        value=estimate.value,
        unit=estimate.unit,
        ci95=interval,
        identified=estimate.identified,
        note=estimate.note,
    )
    return parameter.model_dump(mode="json")
