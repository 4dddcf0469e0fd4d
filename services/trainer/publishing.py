"""A version's files: the card, the weights, one step as a program, the predictions, and the signed manifest."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from physworld.worldmodel import export
from physworld.worldmodel.holding.rollout import with_others
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.scene_view import SceneView
from physworld_schemas.base import Artifact
from physworld_schemas.model import ModelVersion, TrainingConfig
from physworld_schemas.signing import SIGNATURE_NAME
from physworld_services.trainer.measuring import Measured
from physworld_services.trainer.settings import translate
from physworld_storage import signing
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import named, npz_bytes

MANIFEST_NAME, WEIGHTS_NAME = "manifest.json", "model.safetensors"
PROGRAMS = {"torch_export": ("step.pt2", export.torch_program), "onnx": ("step.onnx", export.onnx_program)}

_SEEN = {
    "material": "edges are material, so contact of the object with itself, ",
    "current": "of contact of the object with itself what the demonstrations showed, ",
}


def card_of(
    payload: dict[str, Any],
    config: TrainingConfig,
    published: PublishedModel,
    metrics: dict[str, Any],
    lineage: dict[str, Any],
) -> dict[str, Any]:
    """What the version is: lineage, architecture, settings, metrics, intended use, limits.

    Args:
        payload: of the shard: name, version and the ids that it comes from.
        config: of the training.
        published: the model.
        metrics: held-out errors and speeds, as JSON.
        lineage: inputs, seeds and versions, as JSON.
    """
    return {
        "schema_version": 1,
        "name": payload["name"],
        "version": payload["version"],
        "scene_id": payload["scene_id"],
        "fit_id": payload["fit_id"],
        "trace_id": payload.get("trace_id"),
        "dataset_id": payload["dataset_id"],
        "closed_loop": metrics["closed_loop"],
        "dt_s": published.spec.dt_s,
        "architecture": published.facts(),
        "training": config.model_dump(mode="json"),
        "library_settings": [asdict(part) for part in translate(config)],
        "metrics": {name: value for name, value in metrics.items() if name != "closed_loop"},
        "lineage": lineage,
        "seeds": {"training": config.seed},
        "versions": {
            "torch": torch.__version__,
            "numpy": np.__version__,
            "physworld": lineage["code_version"],
        },
        "intended_use": (
            "Predict the motion of this object under motions of its grips like those of the demonstrations, "
            "open loop, at the time step of the model."
        ),
        "limits": (
            f"One object and {_grips_said(published)}: {_SEEN[config.near_edges]}fracture, flow and other grips are "
            "not represented; motions much faster or wider than the demonstrations are extrapolated; the start needs "
            f"{config.history + 1} frames."
        ),
    }


def held_of(members: Sequence[PublishedModel]) -> list[dict[str, Any]]:
    """``held`` of a card: the models for other sets of grips that are published with a version."""
    return [
        {"grips": list(one.holding or ()), "file": f"held_{number}.safetensors", "architecture": one.facts()}
        for number, one in enumerate(members)
    ]


def _grips_said(published: PublishedModel) -> str:
    """Which grips the version is for."""
    if published.holding is None:
        return "its grips, as recorded"
    return f"of its {len(published.grips)} grips, from 0, only {list(published.holding)}"


def model_of(stores: Stores, version: ModelVersion) -> PublishedModel:
    """A version as it was published. Raises NotFound, or VersionUnreadable for a layout that is not read here."""
    read = stores.artifacts.read_bytes
    card = json.loads(read(named(version.artifacts, "card.json", version.name).sha256))

    def tensors(name: str) -> dict[str, Any]:
        return load_tensors(read(named(version.artifacts, name, version.name).sha256))

    return with_others(tensors(WEIGHTS_NAME), card, tensors)


def store_version(
    stores: Stores,
    payload: dict[str, Any],
    published: PublishedModel,
    view: SceneView,
    measured: Measured,
    card: dict[str, Any],
    begin: Callable[[str], None] = lambda name: None,
    members: Sequence[PublishedModel] = (),
) -> list[Artifact]:
    """The version's files, the manifest and its signature last.

    Args:
        stores: where they are put.
        payload: of the shard: the version's name and number.
        published: the model.
        view: the recording at its vertices.
        measured: its predictions.
        card: what it says of itself.
        begin: called before each program with its format; it raises to end the export.
        members: the models for other sets of grips, which go with it (``held`` of the card).
    """
    put = stores.artifacts.put_bytes
    prediction = {
        "times": view.scene.times,
        "tracks": measured.tracks.astype(np.float32),
        "tracks_calibrated": measured.tracks_calibrated.astype(np.float32),
        "twin_tracks": measured.twin_tracks.astype(np.float32),
        "tick_times": view.times,
        "vertices": measured.vertices.astype(np.float32),
    }
    facts = {"format": "physworld-world-model", "name": payload["name"], "version": str(payload["version"])}
    programs: list[Artifact] = []
    for name in dict.fromkeys(card["training"]["formats"]):
        begin(name)
        programs.append(
            put(PROGRAMS[name][1](published.model), PROGRAMS[name][0], "application/octet-stream")
        )
    artifacts = [
        put(save_tensors(published.to_tensors(), facts), WEIGHTS_NAME, "application/octet-stream"),
        *(
            put(save_tensors(one.to_tensors(), facts), part["file"], "application/octet-stream")
            for one, part in zip(members, card.get("held", []), strict=True)
        ),
        *programs,
        put(json.dumps(card, indent=1, allow_nan=False).encode(), "card.json", "application/json"),
        put(npz_bytes(prediction), "prediction.npz", "application/x-npz"),
    ]
    manifest = {
        "name": payload["name"],
        "version": payload["version"],
        "files": {item.name: {"sha256": item.sha256, "size": item.size} for item in artifacts},
    }
    text = json.dumps(manifest, indent=1, sort_keys=True).encode()
    signer = signing.open_signer(stores.settings)
    with stores.database.session() as session:
        signing.register(session, signer)
    return [
        *artifacts,
        put(text, MANIFEST_NAME, "application/json"),
        put(signer.sign(text), SIGNATURE_NAME, "application/json"),
    ]
