"""The training shard on a real dataset of a tiny scene: published files, resuming, cancelling."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from pydantic import SecretStr
from safetensors.numpy import load
from tiny_scene import register, tiny_scene

from physworld.engine.formulations import FORMULATIONS
from physworld.scene import Ground
from physworld.twin.build import build_twin
from physworld.worldmodel import PublishedModel
from physworld.worldmodel.dataset import VERTEX_ARRAYS, has_vertices, read_track
from physworld.worldmodel.errors import DatasetUnusable
from physworld.worldmodel.scene_view import view_scene
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.model import ModelVersion, TrainingConfig, TrainingCreate
from physworld_schemas.quality import quality_of
from physworld_schemas.signing import ManifestSignature
from physworld_services.trainer import training
from physworld_services.trainer.measuring import json_safe
from physworld_services.trainer.settings import translate
from physworld_storage import registry, resources, signing
from physworld_storage.database import open_database
from physworld_storage.jobs import events as log
from physworld_storage.jobs import jobs, leases
from physworld_storage.settings import Settings
from physworld_storage.tables import ShardRow
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import scene_of, twin_of

pytestmark = pytest.mark.slow

FRAMES = 24
FORMER_ARRAYS = ("times", "particles", "controllers", "properties")
SMALL = TrainingConfig(
    hidden=16,
    message_passing_steps=2,
    history=2,
    look_ahead=2,
    vertices=20,
    steps=16,
    batch_size=2,
    fine_tune_steps=5,
    formats=[],
)


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    """One process that knows every kind of shard, on stores of its own; it can write nothing in its data folder."""
    (tmp_path / "file").write_text("")
    settings = Settings(
        data_dir=tmp_path / "file" / "data",
        database_url=f"sqlite:///{tmp_path / 'physworld.db'}",
        store_url=(tmp_path / "store").as_uri(),
        signing_key=SecretStr(base64.b64encode(bytes(32)).decode()),
        lease_seconds=20.0,
    )
    database = open_database(settings)
    database.upgrade()
    yield Runtime(settings, database, Stores(settings, database), process_owner())
    database.dispose()


@pytest.fixture
def dataset_id(runtime: Runtime) -> str:
    """A sealed dataset of four episodes of the tiny scene's twin."""
    scene_id = register(tiny_scene(FRAMES), runtime.database, runtime.stores.artifacts)
    with runtime.database.session() as session:
        fit = jobs.create_fit(session, scene_id, FitConfig(particle_budget=60, max_simulations=4))
    assert _drain(runtime) == {"done"}
    with runtime.database.session() as session:
        job = jobs.create_dataset(session, fit.outputs[0].id, DatasetConfig(episodes=4))
    assert _drain(runtime) == {"done"}
    return job.outputs[0].id


def _drain(runtime: Runtime) -> set[str]:
    outcomes: set[str] = set()
    while True:
        with runtime.database.reading() as session:
            waiting = leases.publishable(session)
        if not waiting:
            return outcomes
        outcomes |= {run_shard(runtime, publication.shard_id) for publication in waiting}


def _train(runtime: Runtime, dataset_id: str, config: TrainingConfig = SMALL) -> tuple[Job, ModelVersion]:
    with runtime.database.session() as session:
        job = jobs.create_training(session, TrainingCreate(name="bar", dataset_id=dataset_id, config=config))
    _drain(runtime)
    with runtime.database.reading() as session:
        version = registry.list_versions(session, "bar").data[0]
        return jobs.get_job(session, job.id), version


def _files(runtime: Runtime, version: ModelVersion) -> dict[str, bytes]:
    return {item.name: runtime.stores.artifacts.read_bytes(item.sha256) for item in version.artifacts}


def test_a_training_publishes_a_version_that_rolls_out(runtime: Runtime, dataset_id: str) -> None:
    job, version = _train(runtime, dataset_id)
    assert (job.state, version.state) == ("succeeded", "ready"), job.error
    files = _files(runtime, version)
    assert set(files) == {
        "model.safetensors",
        "card.json",
        "prediction.npz",
        "manifest.json",
        "manifest.sig.json",
    }
    with runtime.database.reading() as session:
        (key,) = signing.list_signing_keys(session).data
    signature = ManifestSignature.model_validate_json(files["manifest.sig.json"])
    assert signature.key_id == key.key_id
    public = Ed25519PublicKey.from_public_bytes(base64.b64decode(key.public_key))
    public.verify(base64.b64decode(signature.signature), files["manifest.json"])
    assert hashlib.sha256(files["manifest.json"]).hexdigest() == version.sha256
    manifest = json.loads(files["manifest.json"])
    assert (manifest["name"], manifest["version"]) == ("bar", 1)
    for name, entry in manifest["files"].items():
        assert entry == {"sha256": hashlib.sha256(files[name]).hexdigest(), "size": len(files[name])}
    card = json.loads(files["card.json"])
    published = PublishedModel.from_tensors(load(files["model.safetensors"]), card["architecture"])
    controllers = np.repeat(published.start_controllers[-1:], 10, axis=0)
    assert np.isfinite(published.rollout(controllers)).all()
    with runtime.database.reading() as session:
        digest = resources.get_dataset(session, dataset_id).digest
    assert {item["kind"]: item["digest"] for item in card["lineage"]["inputs"]}["dataset"] == digest
    assert card["trained_on"]["statistics"]["episodes"] == 4 and card["trained_on"]["statistics"]["motions"]
    assert card["intended_use"] and card["limits"]
    assert set(card["metrics"]["held_out"]["per_frame"]["track_m"]) >= {"twin", "world_model", "static"}
    assert not runtime.stores.scratch.has(job.id, training.CHECKPOINT)


def test_progress_covers_what_follows_the_steps_and_never_falls(runtime: Runtime, dataset_id: str) -> None:
    job, _ = _train(runtime, dataset_id)
    with runtime.database.reading() as session:
        told = [event.data for event in log.events_after(session, job.id, 0) if event.type == "progress"]
        figures = log.figures_of(session, job.id)
    fractions = [data["fraction"] for data in told]
    assert len(fractions) >= 2 and fractions == sorted(
        fractions
    )  # a report each for stages that lasted 0.5 s
    training = [data["fraction"] for data in told if data["message"].startswith("loss")]
    assert max(training, default=0.0) < 0.95  # fine-tuning, measuring and exporting are still to come
    assert job.share == 1.0 and job.progress.eta_s is None
    assert {name for _, one in figures for name in one} <= {"loss", "validation_m"} and figures


def test_a_field_of_friction_is_stored_learned_and_tuned_as_one_number(runtime: Runtime) -> None:
    scene = dataclasses.replace(tiny_scene(FRAMES), ground=Ground(-0.01))
    scene_id = register(scene, runtime.database, runtime.stores.artifacts)
    with runtime.database.session() as session:
        fit = jobs.create_fit(session, scene_id, FitConfig(particle_budget=60, max_simulations=4))
    assert _drain(runtime) == {"done"}
    asked = DatasetConfig(episodes=4, properties=["stiffness", "friction"])
    with runtime.database.session() as session:
        job = jobs.create_dataset(session, fit.outputs[0].id, asked)
    assert _drain(runtime) == {"done"}
    with runtime.database.reading() as session:
        stored = resources.all_episodes(session, job.outputs[0].id)
        figures = resources.get_dataset(session, job.outputs[0].id).statistics
    for one in stored:
        properties = runtime.stores.episodes.verified(one.path, one.digest)[0]["properties"]
        assert properties.shape[1] == 3 and np.ptp(properties[:, 2]) > 0.0
    assert json.dumps(figures)
    _, version = _train(runtime, job.outputs[0].id)
    assert version.state == "ready"
    tuned = version.metrics["fine_tuning"]["strengths"]["ground.friction"]
    assert tuned["bounds"][0] <= tuned["tuned"] <= tuned["bounds"][1]
    assert tuned["bounds"][1] == pytest.approx(tuned["calibrated"] * np.exp(0.6))
    weights = load(_files(runtime, version)["model.safetensors"])
    assert weights["norm.properties"].shape == (2,)  # it stands at the tuned friction


def test_a_training_reads_the_vertices_alone_and_learns_the_same(runtime: Runtime, dataset_id: str) -> None:
    with runtime.database.reading() as session:
        stored = resources.all_episodes(session, dataset_id)
        scene_id = resources.get_dataset(session, dataset_id).scene_id
        fit_id = resources.get_dataset(session, dataset_id).fit_id
    architecture = translate(SMALL)[0]
    view = view_scene(scene_of(runtime.stores, scene_id), twin_of(runtime.stores, fit_id), architecture)
    for one in stored:
        whole = runtime.stores.episodes.verified(one.path, one.digest)[0]
        part = runtime.stores.episodes.verified(one.path, one.digest, VERTEX_ARRAYS)[0]
        assert "particles" not in part and has_vertices(view.spec, part)
        former = {name: array for name, array in whole.items() if name in FORMER_ARRAYS}
        assert not has_vertices(view.spec, former)
        tracks = [read_track(view.spec, arrays, architecture.history) for arrays in (part, whole, former)]
        assert torch.equal(tracks[0].positions, tracks[2].positions)
        assert torch.equal(tracks[1].positions, tracks[2].positions)
        assert torch.equal(tracks[0].phi, tracks[2].phi)
        other = dataclasses.replace(view.spec, particle_index=view.spec.particle_index[::-1].copy())
        assert not has_vertices(other, part)
        with pytest.raises(DatasetUnusable, match="is of another body"):
            read_track(other, part, architecture.history)


def test_a_version_with_current_neighbours_and_no_prior_rolls_out(runtime: Runtime, dataset_id: str) -> None:
    asked = SMALL.model_copy(update={"near_edges": "current", "prior": "none", "formats": ["onnx"]})
    job, version = _train(runtime, dataset_id, asked)
    assert (job.state, version.state) == ("succeeded", "ready"), job.error
    files = _files(runtime, version)
    card, tensors = json.loads(files["card.json"]), load(files["model.safetensors"])
    assert card["architecture"]["near_edges"] == "current" and "step.onnx" in files
    assert card["metrics"]["validation"]["prior"] == "none"
    assert "contact of the object with itself what the demonstrations showed" in card["limits"]
    assert "graph.kept_neighbours" in tensors and "graph.neighbours" not in tensors
    published = PublishedModel.from_card(tensors, card)
    assert published.spec.current_neighbours > 0
    controllers = np.repeat(published.start_controllers[-1:], 10, axis=0)
    assert np.isfinite(published.rollout(controllers)).all()


def test_the_metrics_have_every_row_of_the_table(runtime: Runtime, dataset_id: str) -> None:
    _, version = _train(runtime, dataset_id)
    rows = {"static", "rigid_follow", "constant_velocity", "twin", "world_model", "world_model_finetuned"}
    for metric in ("track_m", "chamfer_phystwin_m", "chamfer_l2_m"):
        row = version.metrics["held_out"][metric]
        assert rows <= set(row)
        assert all(row[name] > 0.0 for name in rows)
    assert set(version.metrics["steps_per_second"]) == {"twin", "world_model"}
    low, high = version.metrics["held_out"]["ci95"]["track_m"]["twin"]
    assert low < version.metrics["held_out"]["track_m"]["twin"] < high
    assert version.metrics["episodes"] == 4
    assert version.metrics["validation"]["curve"][-1][0] == SMALL.steps
    assert len(version.metrics["energy"]["still_quarters_m2_s2"]) == 4
    assert version.quality.verdict in {"passed", "failed"}
    card = json.loads(_files(runtime, version)["card.json"])
    assert card["quality"] == version.quality.model_dump(mode="json")


def test_where_the_form_of_the_twin_is_fast_the_version_says_that_the_twin_answers(
    runtime: Runtime, dataset_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = _train(runtime, dataset_id)[1].metrics
    monkeypatch.setattr(FORMULATIONS["total_lagrangian"], "fast", True)
    fast = _train(runtime, dataset_id)[1].metrics
    assert (plain["predictor"], plain["notes"]) == ("model", [])
    assert (fast["predictor"], fast["notes"]) == ("twin", [training.TWIN_ANSWERS])
    assert FORMULATIONS["discrete_rod"].fast


def test_the_same_inputs_give_the_same_weights(runtime: Runtime, dataset_id: str) -> None:
    digests = []
    for _ in range(2):
        _, version = _train(runtime, dataset_id)
        tensors = load(_files(runtime, version)["model.safetensors"])
        digests.append({name: value.tobytes() for name, value in tensors.items()})
    assert digests[0] == digests[1]


def test_a_training_goes_on_from_a_version(runtime: Runtime, dataset_id: str) -> None:
    _, first = _train(runtime, dataset_id)
    _, second = _train(runtime, dataset_id, SMALL.model_copy(update={"start_from": "bar:1"}))
    assert second.state == "ready" and second.config.start_from == "bar:1"
    card = json.loads(_files(runtime, second)["card.json"])
    (start,) = (item for item in card["lineage"]["inputs"] if item["kind"] == "model")
    assert (start["id"], start["digest"]) == ("bar:1", first.sha256)
    (prior, begun, *_), before = (one.metrics["validation"]["curve"] for one in (second, first))
    assert prior == before[0] and begun[0] == 0
    assert begun[1] == pytest.approx(first.metrics["validation"]["open_loop_m"], rel=1e-5)


def test_a_killed_training_carries_on_from_its_checkpoint(
    runtime: Runtime, dataset_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = load(_files(runtime, _train(runtime, dataset_id)[1])["model.safetensors"])
    real_train, resumed = training.train, []

    def killed_once(*arguments, checkpoint, save_checkpoint, **options):
        resumed.append(checkpoint is not None)

        def save(data: bytes) -> None:
            save_checkpoint(data)
            if len(resumed) == 1:
                raise OSError("killed after its checkpoint")

        return real_train(*arguments, checkpoint=checkpoint, save_checkpoint=save, **options)

    monkeypatch.setattr(training, "train", killed_once)
    with runtime.database.session() as session:
        jobs.create_training(session, TrainingCreate(name="bar", dataset_id=dataset_id, config=SMALL))
    with runtime.database.reading() as session:
        (first,) = leases.publishable(session)
    run_shard(runtime, first.shard_id)
    with runtime.database.session() as session:
        session.get_one(ShardRow, first.shard_id).not_before = None  # the pause before a retry
    run_shard(runtime, first.shard_id)
    with runtime.database.reading() as session:
        version = registry.list_versions(session, "bar").data[0]
    assert resumed == [False, True]
    again = load(_files(runtime, version)["model.safetensors"])
    assert all(np.array_equal(whole[name], again[name]) for name in whole)


def test_settings_of_the_wire_reach_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PHYSWORLD_TRAINER_THREADS", "2")
    architecture, settings, tuning = translate(SMALL)
    assert (architecture.hidden, architecture.vertices, architecture.history) == (16, 20, 2)
    assert (settings.steps, settings.look_ahead, settings.threads) == (16, 2, 2)
    assert tuning.steps == 5


def test_numbers_that_json_lacks_become_null() -> None:
    value = {"a": [np.float64("inf"), np.int64(3)], "b": (float("nan"), True, None, "x")}
    assert json_safe(value) == {"a": [None, 3], "b": [None, True, None, "x"]}


def test_a_rollout_that_left_the_numbers_is_published_as_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    from physworld.worldmodel.model.model import WorldModel
    from physworld.worldmodel.scene_view import view_scene

    scene = tiny_scene(FRAMES)
    architecture, _, _ = translate(SMALL)
    view = view_scene(scene, build_twin(scene, 60), architecture)
    model = WorldModel(architecture, view.spec)
    phi = np.zeros((view.spec.object_count, 2))
    model.prior.mean.fill_(float("inf"))
    measured = training.measure(view, view.published(model, phi, phi))
    assert measured.table["track_m"]["world_model"] is None
    assert measured.table["track_m"]["twin"] is not None
    metrics = json_safe({"held_out": measured.table, "energy": measured.energy})
    assert len(quality_of(metrics).reasons) == 2  # on the held-out frames, and while the grips stand still


def test_a_training_begins_while_its_dataset_is_being_written(runtime: Runtime) -> None:
    """It learns from what is there, waits for the rest and the seal, and ends with the weights of a late start."""
    scene_id = register(tiny_scene(FRAMES), runtime.database, runtime.stores.artifacts)
    with runtime.database.session() as session:
        fit = jobs.create_fit(session, scene_id, FitConfig(particle_budget=60, max_simulations=4))
    _drain(runtime)
    streamed = SMALL.model_copy(update={"start_share": 0.5})
    with runtime.database.session() as session:
        made = jobs.create_dataset(session, fit.outputs[0].id, DatasetConfig(episodes=6))
        request = TrainingCreate(name="bar", dataset_id=made.outputs[0].id, config=streamed)
        job = jobs.create_training(session, request)
    with runtime.database.reading() as session:
        waiting = leases.publishable(session)
    (training_shard,) = [item.shard_id for item in waiting if item.kind == "training"]
    with ThreadPoolExecutor(1) as pool:
        outcome = pool.submit(run_shard, runtime, training_shard)
        _write_episodes(runtime, 3)
        progress = _until(runtime, job, lambda found: found.progress.done > 0)
        assert not outcome.done()
        with runtime.database.reading() as session:
            assert resources.get_dataset(session, made.outputs[0].id).episodes_done == 3
        assert progress.progress.done <= SMALL.steps * 0.5
        _drain(runtime)
        assert outcome.result(60) == "done"
    with runtime.database.session() as session:
        jobs.create_training(session, request)
    _drain(runtime)
    with runtime.database.reading() as session:
        late, early = registry.list_versions(session, "bar").data
        digest = resources.get_dataset(session, made.outputs[0].id).digest
    assert early.metrics["episodes"] == late.metrics["episodes"] == 6
    assert {item.kind: item.digest for item in early.lineage.inputs}["dataset"] == digest
    weights = [load(_files(runtime, version)["model.safetensors"]) for version in (early, late)]
    assert all(np.array_equal(weights[0][name], weights[1][name]) for name in weights[0])


def _write_episodes(runtime: Runtime, count: int) -> None:
    """The plan, and the first so many episodes."""
    for kind, shards in (("dataset_plan", 1), ("episode", count)):
        for _ in range(shards):
            with runtime.database.reading() as session:
                waiting = leases.publishable(session)
            first = next(item.shard_id for item in waiting if item.kind == kind)
            assert run_shard(runtime, first) == "done"


def _until(runtime: Runtime, job: Job, reached: Callable[[Job], bool]) -> Job:
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        with runtime.database.reading() as session:
            found = jobs.get_job(session, job.id)
        if reached(found):
            return found
        time.sleep(0.05)
    raise AssertionError(f"job {job.id} is {found.state} at {found.progress}")
