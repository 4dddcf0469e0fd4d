"""Trainings on a dataset whose episodes say which grips hold, and the versions that come of them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from safetensors.numpy import load
from tiny_scene import between_two_grips, register

from physworld.worldmodel import PublishedModel
from physworld.worldmodel.errors import ControlsInvalid
from physworld.worldmodel.holding.rollout import HeldVersions
from physworld_schemas.arrays import EncodedArray
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.model import ModelVersion, TrainingConfig, TrainingCreate
from physworld_schemas.rollout import RolloutCreate
from physworld_services.inference import rollouts
from physworld_services.inference.models import Models
from physworld_services.trainer import training
from physworld_storage import registry
from physworld_storage.database import open_database
from physworld_storage.episodes import Arrays, EpisodeStore
from physworld_storage.jobs import jobs, leases
from physworld_storage.settings import Settings
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores

pytestmark = pytest.mark.slow

FRAMES, OPENED, CLOSED = 24, 6, 15
SMALL = TrainingConfig(
    hidden=16,
    message_passing_steps=2,
    history=2,
    look_ahead=12,
    vertices=20,
    steps=4,
    batch_size=2,
    fine_tune_steps=5,
    formats=[],
)


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    """One process that knows every kind of shard, on stores of its own."""
    settings = Settings(
        data_dir=tmp_path / "data",
        database_url=f"sqlite:///{tmp_path / 'physworld.db'}",
        store_url=(tmp_path / "store").as_uri(),
        lease_seconds=20.0,
    )
    database = open_database(settings)
    database.upgrade()
    yield Runtime(settings, database, Stores(settings, database), process_owner())
    database.dispose()


@pytest.fixture
def dataset_id(runtime: Runtime, monkeypatch: pytest.MonkeyPatch) -> str:
    """Four episodes whose second grip is said to be open from ``OPENED`` to ``CLOSED``."""
    write = EpisodeStore.write

    def with_holding(
        self: EpisodeStore,
        dataset: str,
        index: int,
        epoch: int,
        arrays: Arrays,
        attributes: Mapping[str, Any],
    ) -> tuple[str, str]:
        holding = np.ones((len(arrays["times"]), 2), dtype=np.uint8)
        holding[OPENED:CLOSED, 1] = 0
        return write(self, dataset, index, epoch, {**arrays, "holding": holding}, attributes)

    monkeypatch.setattr(EpisodeStore, "write", with_holding)
    scene_id = register(between_two_grips(FRAMES), runtime.database, runtime.stores.artifacts)
    with runtime.database.session() as session:
        fit = jobs.create_fit(session, scene_id, FitConfig(particle_budget=60, max_simulations=2))
    _drain(runtime)
    with runtime.database.session() as session:
        settings = DatasetConfig(episodes=4, replay_share=0.0)
        job = jobs.create_dataset(session, fit.outputs[0].id, settings)
    _drain(runtime)
    return job.outputs[0].id


def _drain(runtime: Runtime) -> None:
    while True:
        with runtime.database.reading() as session:
            waiting = leases.publishable(session)
        if not waiting:
            return
        for publication in waiting:
            run_shard(runtime, publication.shard_id)


def _train(runtime: Runtime, dataset_id: str, name: str, holding: list[int] | None) -> ModelVersion:
    asked = TrainingCreate(
        name=name, dataset_id=dataset_id, config=SMALL.model_copy(update={"holding": holding})
    )
    with runtime.database.session() as session:
        jobs.create_training(session, asked)
    _drain(runtime)
    with runtime.database.reading() as session:
        return registry.list_versions(session, name).data[0]


def _published(runtime: Runtime, version: ModelVersion) -> tuple[PublishedModel, dict[str, Any]]:
    files = {item.name: runtime.stores.artifacts.read_bytes(item.sha256) for item in version.artifacts}
    card = json.loads(files["card.json"])
    return PublishedModel.from_card(load(files["model.safetensors"]), card), card


def test_one_dataset_gives_a_version_for_each_set_of_grips(
    runtime: Runtime, dataset_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, seen = training.train, []

    def noted(tracks: Any, *arguments: Any, **options: Any) -> Any:
        settings = arguments[2]
        seen.append(([[len(part.positions) for part in parts] for parts in tracks], settings.look_ahead))
        return real(tracks, *arguments, **options)

    monkeypatch.setattr(training, "train", noted)
    both, left = (
        _train(runtime, dataset_id, name, holding) for name, holding in (("bar", None), ("bar.left", [0]))
    )
    assert (both.state, left.state) == ("ready", "ready"), (both.message, left.message)
    after = FRAMES - CLOSED + SMALL.history
    assert seen[0] == ([[OPENED + 1, after]] * 4, OPENED - SMALL.history)
    assert seen[1] == ([[CLOSED - OPENED + 1 + SMALL.history]] * 4, CLOSED - OPENED)

    (whole, card), (alone, other) = _published(runtime, both), _published(runtime, left)
    assert (card["architecture"]["holding"], other["architecture"]["holding"]) == (None, [0])
    assert card["architecture"]["grips"] == other["architecture"]["grips"] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert set(whole.spec.control_index) == set(range(8)) and set(alone.spec.control_index) == set(range(4))
    assert np.array_equal(whole.spec.particle_index, alone.spec.particle_index)
    assert "of its 2 grips, from 0, only [0]" in other["limits"] and "as recorded" in card["limits"]

    table = left.metrics["held_out"]["track_m"]
    assert "world_model_finetuned" in both.metrics["held_out"]["track_m"]
    assert both.metrics["judged_on_recording"] and not left.metrics["judged_on_recording"]
    assert both.metrics["notes"] == [] and "Other grips hold" in left.metrics["notes"][0]
    assert not {"world_model", "world_model_finetuned"} & set(table) and table["twin"] > 0.0
    assert left.metrics["world_model_against_twin_m"] is None and left.metrics["fine_tuning"]["steps"] == 0
    assert left.quality.metric is None and left.metrics["validation"]["open_loop_m"] > 0.0

    controllers = np.repeat(whole.start_controllers[-1:], 20, axis=0)
    holding = np.ones((20, 2))
    holding[8:14, 1] = 0
    path = HeldVersions.of([whole, alone]).rollout(controllers, holding)
    assert path.shape == (20, 20, 3) and np.isfinite(path).all()


def test_a_set_that_no_demonstration_shows_cannot_be_trained(runtime: Runtime, dataset_id: str) -> None:
    version = _train(runtime, dataset_id, "bar.right", [1])
    assert version.state == "failed"
    assert "in none of the 4 episodes" in version.message and "grips [1]" in version.message
    missing = _train(runtime, dataset_id, "bar.third", [2])
    assert missing.state == "failed" and "of the 2 that there are" in missing.message


def test_grips_are_named_once_and_in_order() -> None:
    assert TrainingConfig(holding=[2, 0]).holding == [0, 2]
    assert TrainingConfig().holding is None
    for wrong in ([], [1, 1], [-1]):
        with pytest.raises(ValidationError):
            TrainingConfig(holding=wrong)


def test_a_recording_in_which_a_grip_lets_go_gives_one_version_that_follows_it(
    runtime: Runtime, tmp_path: Path
) -> None:
    scene, fps = between_two_grips(FRAMES), 30.0
    far = dataclasses.replace(scene.grips[1], open_s=((OPENED / fps, CLOSED / fps),))
    scene_id = register(
        dataclasses.replace(scene, grips=(scene.grips[0], far)), runtime.database, runtime.stores.artifacts
    )
    with runtime.database.session() as session:
        fit = jobs.create_fit(session, scene_id, FitConfig(particle_budget=60, max_simulations=2))
    _drain(runtime)
    with runtime.database.session() as session:
        settings = DatasetConfig(episodes=6, replay_share=0.5)
        dataset = jobs.create_dataset(session, fit.outputs[0].id, settings).outputs[0].id
    _drain(runtime)
    version = _train(runtime, dataset, "caught", None)
    assert version.state == "ready", version.message
    table = version.metrics["held_out"]["track_m"]
    assert version.metrics["judged_on_recording"] and version.metrics["notes"] == []
    assert version.metrics["predictor"] == "model"
    assert table["world_model"] == table["world_model_finetuned"] > 0.0

    for item in version.artifacts:
        (tmp_path / item.name).write_bytes(runtime.stores.artifacts.read_bytes(item.sha256))
    card = json.loads((tmp_path / "card.json").read_text())
    assert [(part["grips"], part["file"]) for part in card["held"]] == [([0], "held_0.safetensors")]
    versions = HeldVersions.published(tmp_path)
    assert set(versions.models.members) == {(0, 1), (0,)}
    with np.load(tmp_path / "prediction.npz") as prediction:
        vertices = prediction["vertices"]
    view = training.view_scene(
        training.scene_of(runtime.stores, scene_id),
        training.twin_of(runtime.stores, fit.outputs[0].id, None),
        versions.models.members[(0, 1)].config,
    )
    assert view.held is not None and not view.as_recorded and view.held[:, 1].min() == 0
    again = versions.rollout(view.controllers[view.first :], view.held[view.first :])
    assert np.abs(again - vertices[view.first :]).max() < 1e-5
    model = Models(runtime.database, runtime.stores.artifacts).get("caught", 1)[1]
    asked = RolloutCreate(
        model="caught",
        controllers=EncodedArray.of(view.controllers[view.first :]),
        open_s=[[], [(OPENED / fps, CLOSED / fps)]],
        returns=["vertices"],
    )
    over_http, _ = rollouts.run(asked, model, rollouts.prepare(asked, model))
    assert np.abs(over_http["vertices"][0] - again).max() < 1e-5
    for wrong, says in (
        ([[]] * 3 + [[(0.1, 0.2)]], "4 grips; this version knows 2"),
        ([[], [(0.2, 0.1)]], "open from 0.2 to 0.1 s"),
        ([[(0.2, 0.3)], []], r"from 0.2 s on only grips \[1\] hold"),
    ):
        with pytest.raises(ControlsInvalid, match=says):
            rollouts.prepare(asked.model_copy(update={"open_s": wrong}), model)

    alone = PublishedModel.from_card(load((tmp_path / "model.safetensors").read_bytes()), card)
    assert np.abs(alone.rollout(view.controllers[view.first :]) - again).max() > 1e-4
