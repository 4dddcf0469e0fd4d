"""A published world model of the tiny scene, made without the service: twin, a few episodes, some training steps."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from safetensors.numpy import save as save_tensors
from tiny_scene import between_two_grips, register, tiny_scene, tiny_thing

from physworld.demonstrate import DemonstrationConfig, StrengthRange, derived_seed, make_episode
from physworld.effects.registry import effect
from physworld.scene import Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin
from physworld.worldmodel.dataset import read_track
from physworld.worldmodel.holding.spans import train_held
from physworld.worldmodel.model.conditioning import Conditioning
from physworld.worldmodel.model.config import TrainingConfig, WorldModelConfig
from physworld.worldmodel.model.properties import PROPERTIES
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.scene_view import view_scene
from physworld.worldmodel.training import train
from physworld_schemas.base import Lineage
from physworld_schemas.fit import FitConfig
from physworld_schemas.model import TrainingConfig as WireConfig
from physworld_services.trainer.episodes import column_of
from physworld_services.trainer.publishing import held_of
from physworld_storage import registry
from physworld_storage.artifacts import ArtifactStore
from physworld_storage.database import Database
from physworld_storage.jobs import jobs, leases

NAME = "tiny-bar"
FRAMES, EPISODES = 24, 6
SMALL = WorldModelConfig(hidden=16, message_passing_steps=2, history=2, vertices=20, neighbours=5, modes=6)


DRAG = StrengthRange("air_drag_linear", "rate_per_s", 2.0, 0.5, 3.5)
"""Strength of an effect that the demonstrations of a dragged thing vary: what its trace said, and the interval."""


@cache
def tiny_model(kind: str = "beam", dragged: bool = False) -> tuple[Scene, Twin, PublishedModel]:
    """The scene, its twin with prior parameters, and a model that learned from the twin: a bar's, or a thing's.

    ``kind``: "between two grips" is a bar of which one of them may let go; ``dragged``: the twin has ``DRAG``, and its
    demonstrations vary it.
    """
    if kind == "between two grips":
        return _between()
    scene = tiny_scene(FRAMES) if kind == "beam" else tiny_thing(kind, FRAMES)
    twin = build_twin(scene, 60)
    twin = twin.with_parameters(youngs_modulus_pa=3e4) if kind == "beam" else twin
    columns, column = PROPERTIES, column_of(DRAG, "1/s")
    if dragged:
        twin = twin.with_effect(effect(DRAG.effect, **{DRAG.name: DRAG.value}))
        columns = (*PROPERTIES, column)
    view = view_scene(scene, twin, SMALL)
    settings = DemonstrationConfig(frames=FRAMES, strengths=(DRAG,) if dragged else ())
    episodes = [make_episode(scene, twin, settings, derived_seed(0, index)) for index in range(EPISODES)]
    tracks = []
    for arrays, told in episodes:
        drawn = {name: column.column_of(value) for name, value in told["effect_strengths"].items()}
        tracks.append(read_track(view.spec, arrays, SMALL.history, columns, drawn))
    training = TrainingConfig(steps=12, batch_size=2, look_ahead=2)
    if dragged:  # a prior that leaves something to learn: a network that adds nothing to it has no strengths
        training = replace(training, prior="modal", frame="world", validation_every=2)
    model = train(tracks, view.spec, SMALL, training, columns=columns).model
    phi, stands = np.zeros((view.spec.object_count, 2)), {column.name: 0.0} if dragged else {}
    return scene, twin, view.published(model.at_strengths(stands), phi, phi, Conditioning.of(model, stands))


def _between() -> tuple[Scene, Twin, PublishedModel]:
    """A bar between two grips, with models for both of them and for the first alone."""
    scene = between_two_grips(FRAMES)
    twin = build_twin(scene, 60).with_parameters(youngs_modulus_pa=3e4)
    settings = DemonstrationConfig(frames=3 * FRAMES, regrasp_share=1.0)
    episodes = [make_episode(scene, twin, settings, derived_seed(0, index))[0] for index in range(EPISODES)]
    sets = ((0, 1), (0,))
    views = {grips: view_scene(scene, twin, SMALL, None if len(grips) == 2 else grips) for grips in sets}
    training = TrainingConfig(steps=2, batch_size=2, look_ahead=2)
    specs = {grips: view.spec for grips, view in views.items()}
    models = train_held(episodes, specs, 2, SMALL, training)
    phi = np.zeros((views[0, 1].spec.object_count, 2))
    whole, alone = (views[grips].published(models[grips].model, phi, phi) for grips in sets)
    return scene, twin, replace(whole, others=(alone,))


def publish_tiny(
    database: Database,
    artifacts: ArtifactStore,
    *,
    name: str = NAME,
    kind: str = "beam",
    dragged: bool = False,
    acting: tuple[str, dict[str, float]] | None = None,
    lacking: str | None = None,
    card: dict[str, Any] | None = None,
    changed: dict[str, Callable[[np.ndarray], np.ndarray]] | None = None,
    weights: bytes | None = None,
    hidden: int | None = None,
    metrics: dict[str, Any] | None = None,
) -> tuple[str, int]:
    """Register scene, fit and model; the model's name and version.

    ``kind``: of the thing; ``dragged``: as of ``tiny_model``; ``acting``: an effect of the twin beside the model, with
    its strengths; ``lacking``: a tensor that is left out, as in a version of an older layout; ``card``: more of its
    card; ``changed``: what becomes of tensors, by name; ``weights``: a file in the place of them all; ``hidden``: a
    measured point that the recording sees in its first frame only; ``metrics``: of the version.
    """
    scene, twin, model = tiny_model(kind, dragged)
    if hidden is not None:
        visible = scene.visible.copy()
        visible[1:, hidden] = False
        scene = replace(scene, visible=visible)
    twin = twin if acting is None else twin.with_effect(effect(acting[0], **acting[1]))
    scene_id = register(scene, database, artifacts)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **twin.to_arrays())
    file = artifacts.put_bytes(buffer.getvalue(), "twin.npz")
    with database.session() as session:
        job = jobs.create_fit(session, scene_id, FitConfig())
    with database.session() as session:
        waiting = next(p for p in leases.publishable(session) if p.kind == "fit")
        leases.mark_published(session, [waiting])
        lease = leases.claim(session, waiting.shard_id, "test", 30.0)
        assert lease is not None
        result = {"parameters": {}, "metrics": {}, "artifacts": [file.model_dump()]}
        assert leases.complete(session, lease, result, None)
    told = {"architecture": model.facts(), "held": held_of(model.others)}
    text = json.dumps(told | (card or {})).encode()
    tensors = {part: values for part, values in model.to_tensors().items() if part != lacking}
    tensors |= {part: np.ascontiguousarray(change(tensors[part])) for part, change in (changed or {}).items()}
    files = [
        artifacts.put_bytes(weights or save_tensors(tensors, {}), "model.safetensors"),
        artifacts.put_bytes(text, "card.json", "application/json"),
    ]
    for part, other in zip(told["held"], model.others, strict=True):
        files.append(artifacts.put_bytes(save_tensors(other.to_tensors(), {}), part["file"]))
    config = WireConfig(hidden=16, message_passing_steps=2, history=2, vertices=20)
    with database.session() as session:
        row = registry.allot_version(
            session, name, config=config, scene_id=scene_id, fit_id=job.outputs[0].id
        )
        manifest = artifacts.put_bytes(f"{name} {row.version}".encode(), "manifest.json")
        registry.publish(
            session,
            name,
            row.version,
            artifacts=[*files, manifest],
            sha256=manifest.sha256,
            metrics=metrics or {},
            lineage=Lineage(),
        )
        return name, row.version
