"""The card of a model behind a trace, and new recordings held against a model; one small model for all tests."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load
from tiny_scene import register, tiny_scene

from physworld.effects.registry import effect
from physworld.errors import SceneUnsupported
from physworld.estimation.noise import freeze
from physworld.worldmodel.foreign import ForeignPrediction
from physworld.worldmodel.published import PublishedModel
from physworld_schemas.assessment import Assessment, AssessmentCreate
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.model import ModelVersion, TrainingConfig, TrainingCreate
from physworld_schemas.trace import TraceCreate
from physworld_services.trainer.assessment import assess, scored_frames
from physworld_storage import registry, traces
from physworld_storage.database import open_database
from physworld_storage.jobs import jobs, leases
from physworld_storage.settings import Settings
from physworld_storage.tables import TraceRow
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import named, npz_bytes, twin_of

pytestmark = pytest.mark.slow

WEIGHTS = "model.safetensors"
FRAMES = 48
FIT = FitConfig(particle_budget=60, max_simulations=4)
SMALL = TrainingConfig(
    hidden=16, message_passing_steps=2, history=2, look_ahead=2, vertices=20, steps=80, batch_size=2,
    fine_tune_steps=5,
    formats=[],
)  # fmt: skip


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtime]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("data"), lease_seconds=20.0)
    database = open_database(settings)
    database.upgrade()
    yield Runtime(settings, database, Stores(settings, database), process_owner())
    database.dispose()


def _drain(runtime: Runtime) -> set[str]:
    outcomes: set[str] = set()
    while True:
        with runtime.database.reading() as session:
            waiting = leases.publishable(session)
        if not waiting:
            return outcomes
        outcomes |= {run_shard(runtime, publication.shard_id) for publication in waiting}


@pytest.fixture(scope="module")
def scene_id(runtime: Runtime) -> str:
    return register(tiny_scene(FRAMES), runtime.database, runtime.stores.artifacts)


@pytest.fixture(scope="module")
def fit_id(runtime: Runtime, scene_id: str) -> str:
    with runtime.database.session() as session:
        job = jobs.create_fit(session, scene_id, FIT)
    assert _drain(runtime) == {"done"}
    return job.outputs[0].id


def _version(runtime: Runtime, fit_id: str, trace_id: str | None) -> ModelVersion:
    with runtime.database.session() as session:
        made = jobs.create_dataset(session, fit_id, DatasetConfig(episodes=2), trace_id)
    assert _drain(runtime) == {"done"}
    with runtime.database.session() as session:
        request = TrainingCreate(name="bar", dataset_id=made.outputs[0].id, config=SMALL)
        job = jobs.create_training(session, request)
    assert _drain(runtime) == {"done"}
    with runtime.database.reading() as session:
        return registry.get_version(session, "bar", int(job.outputs[0].id.rpartition(":")[2]))


@pytest.fixture(scope="module")
def plain(runtime: Runtime, fit_id: str) -> ModelVersion:
    """A version on the fit's own twin."""
    return _version(runtime, fit_id, None)


def _trace(runtime: Runtime, scene_id: str, fit_id: str, verdict: str) -> str:
    """A ready trace, as a worker leaves it, of a twin with a drag of 2 1/s."""
    twin = twin_of(runtime.stores, fit_id).with_effect(effect("air_drag_linear", rate_per_s=2.0))
    artifact = runtime.stores.artifacts.put_bytes(npz_bytes(twin.to_arrays()), "twin.npz")
    number = {"value": 2.0, "unit": "1/s", "ci95": [1.5, 2.5]}
    with runtime.database.session() as session:
        job = jobs.create_trace(session, TraceCreate(scene_id=scene_id, fit=FIT))
        row = session.get_one(TraceRow, job.outputs[0].id)
        alone = runtime.stores.artifacts.put_bytes(
            npz_bytes(twin_of(runtime.stores, fit_id).to_arrays()), "declared.npz"
        )
        row.state, row.verdict = "ready", verdict
        added = [artifact.model_dump()] if verdict in ("named", "equivalent_set") else []
        row.artifacts = [*added, alone.model_dump()]
        effects = [{"name": "air_drag_linear", "parameters": {"rate_per_s": number}}]
        row.report = {
            "verdict": verdict,
            "reason": "it fits best",
            "effects": effects,
            "held_out": {"before": 1.0},
        }
        jobs.cancel_job(session, job.id)
    return row.id


def test_a_model_without_a_trace_says_nothing_of_one(plain: ModelVersion) -> None:
    assert plain.trace_id is None and plain.metrics["closed_loop"] is None


def test_the_card_says_which_effect_and_the_errors_before_and_after(
    runtime: Runtime, scene_id: str, fit_id: str, plain: ModelVersion
) -> None:
    version = _version(runtime, fit_id, _trace(runtime, scene_id, fit_id, "named"))
    artifact = named(version.artifacts, "card.json", "bar")
    card = json.loads(runtime.stores.artifacts.read_bytes(artifact.sha256))
    section = card["closed_loop"]
    assert section == version.metrics["closed_loop"]
    assert section["effects_added"][0]["parameters"]["rate_per_s"]["ci95"] == [1.5, 2.5]
    assert "air_drag_linear (rate_per_s 2 1/s, 95 % 1.5 to 2.5)" in section["statement"]
    assert section["baseline_version"] == plain.version
    strength = card["metrics"]["fine_tuning"]["strengths"]["air_drag_linear.rate_per_s"]
    assert (strength["calibrated"], strength["ci95"]) == (2.0, [1.5, 2.5])
    assert 1.5 <= strength["tuned"] <= 2.5
    assert plain.metrics["fine_tuning"]["strengths"] == {}
    weights = load(runtime.stores.artifacts.read_bytes(named(version.artifacts, WEIGHTS, "bar").sha256))
    assert weights["norm.properties"].shape == (2,), "a published version takes no strengths"
    told = card["architecture"]["strengths"]
    assert [(one["name"], one["unit"], one["range"]) for one in told] == [
        ("air_drag_linear.rate_per_s", "1/s", [1.5, 2.5])
    ]
    assert told[0]["value"] == pytest.approx(strength["tuned"], rel=1e-6)
    model = PublishedModel.from_card(weights, card)
    driven = np.repeat(model.start_controllers[-1:], 12, axis=0)
    driven[: len(model.start_controllers)] = model.start_controllers
    paths = [model.at_strengths({told[0]["name"]: rate}).rollout(driven) for rate in (1.5, 2.5)]
    assert np.abs(paths[1] - paths[0]).max() > 0.0, "the strength does nothing"
    for name, row in (("twin", "twin"), ("world_model", "world_model_finetuned")):
        figures = section[name]
        assert figures["after_m"] == pytest.approx(version.metrics["held_out"]["track_m"][row])
        assert figures["before_m"] == pytest.approx(plain.metrics["held_out"]["track_m"][row])
        assert figures["gain_m"] == pytest.approx(figures["before_m"] - figures["after_m"])
        assert figures["gain_ci95_m"][0] <= figures["gain_m"] <= figures["gain_ci95_m"][1]
    assert section["twin"]["before_m"] != section["twin"]["after_m"]
    assert section["twin"]["recalibrated_m"] == pytest.approx(section["twin"]["before_m"])
    assert {item["kind"] for item in card["lineage"]["inputs"]} == {"dataset", "scene", "fit", "trace"}


def test_the_card_says_why_nothing_was_added(
    runtime: Runtime, scene_id: str, fit_id: str, plain: ModelVersion
) -> None:
    version = _version(runtime, fit_id, _trace(runtime, scene_id, fit_id, "unexplained"))
    section = version.metrics["closed_loop"]
    assert section["effects_added"] == [] and "world_model" not in section
    assert section["statement"].startswith(
        "Nothing was added to the twin, the verdict is unexplained: it fits"
    )
    assert version.metrics["held_out"]["track_m"]["twin"] == plain.metrics["held_out"]["track_m"]["twin"]


def test_the_best_of_an_equivalent_set_is_added_and_called_that(
    runtime: Runtime, scene_id: str, fit_id: str, plain: ModelVersion
) -> None:
    version = _version(runtime, fit_id, _trace(runtime, scene_id, fit_id, "equivalent_set"))
    section = version.metrics["closed_loop"]
    assert [effect["name"] for effect in section["effects_added"]] == ["air_drag_linear"]
    assert "the best of a set that these data cannot tell apart" in section["statement"]
    assert section["twin"]["after_m"] is not None and section["baseline_version"] == plain.version


def _assess(runtime: Runtime, scene_id: str, **request: object) -> tuple[Job, Assessment]:
    with runtime.database.session() as session:
        body = AssessmentCreate.model_validate({"scene_id": scene_id, **request})
        job = jobs.create_assessment(session, "bar", 1, body)
        (waiting,) = leases.publishable(session)
    run_shard(runtime, waiting.shard_id)
    with runtime.database.reading() as session:
        return jobs.get_job(session, job.id), traces.get_assessment(session, job.outputs[0].id)


def test_the_recording_it_was_trained_on_is_as_expected(
    runtime: Runtime, scene_id: str, plain: ModelVersion
) -> None:
    job, found = _assess(runtime, scene_id)
    assert job.state == "succeeded", job.error
    assert found.outcome in {"within_noise", "as_expected"} and found.trace_id is None
    assert found.measured is not None and found.expected is not None
    assert found.expected.error_m == pytest.approx(
        plain.metrics["held_out"]["track_m"]["world_model_finetuned"]
    )
    assert found.expected.ci95_m[0] <= found.expected.error_m <= found.expected.ci95_m[1]
    assert set(found.baselines_m) == {"static", "rigid_follow", "constant_velocity"}


def test_a_recording_with_something_new_opens_a_trace(runtime: Runtime, plain: ModelVersion) -> None:
    scene = tiny_scene(FRAMES)
    drift = np.zeros_like(scene.points)
    drift[6:, 1:, 0] = 0.2
    other = register(replace(scene, points=scene.points + drift), runtime.database, runtime.stores.artifacts)
    job, found = _assess(runtime, other, trace={"iterations": 2})
    assert found.outcome == "worse_than_expected", found.reason
    assert found.excess_ci95_m is not None and found.excess_ci95_m[0] > 0
    with runtime.database.session() as session:
        opened = traces.get_trace(session, str(found.trace_id))
        assert (opened.scene_id, opened.state, opened.config.iterations) == (other, "pending", 2)
        jobs.cancel_job(session, opened.job_id)
    assert [item.kind for item in job.outputs] == ["assessment", "trace"]


def test_a_recording_of_another_object_fails_with_the_numbers(runtime: Runtime, plain: ModelVersion) -> None:
    scene = tiny_scene(FRAMES)
    fewer = replace(scene, controllers=scene.controllers[:, :3], grips=())
    other = register(fewer, runtime.database, runtime.stores.artifacts)
    job, found = _assess(runtime, other)
    assert (job.state, found.state) == ("failed", "failed")
    assert job.error is not None and job.error.code == "scene_unsupported"
    assert "3 controllers, the model was trained with 4" in job.error.detail


def test_a_version_that_left_the_numbers_at_home_promises_nothing(plain: ModelVersion) -> None:
    held_out = plain.metrics["held_out"]
    per_frame = held_out["per_frame"]
    without = {k: v for k, v in per_frame["track_m"].items() if k != "world_model_finetuned"}
    metrics = plain.metrics | {"held_out": held_out | {"per_frame": per_frame | {"track_m": without}}}
    scene = tiny_scene(FRAMES)
    predicted = ForeignPrediction(scene.points, scene.points, 1, 0.0)
    with pytest.raises(SceneUnsupported, match="no error of its own on held-out frames"):
        assess(scene, predicted, plain.model_copy(update={"metrics": metrics}), slice(1, FRAMES))


def test_two_versions_are_held_against_frames_that_neither_has_seen(
    runtime: Runtime, scene_id: str, fit_id: str, plain: ModelVersion
) -> None:
    drag = _version(runtime, fit_id, _trace(runtime, scene_id, fit_id, "named"))
    request = {"frames": "held_out", "compared_with": drag.version, "open_trace": False}
    job, found = _assess(runtime, scene_id, **request)
    assert job.state == "succeeded", job.error
    scene = tiny_scene(FRAMES)
    assert found.measured is not None and found.compared is not None
    assert found.measured.frames == found.compared.measured.frames == scene.test[1] - scene.test[0]
    assert found.compared.version == drag.version
    gain = found.compared.gain_m
    assert gain == pytest.approx(found.compared.measured.error_m - found.measured.error_m)
    assert found.compared.gain_ci95_m[0] <= gain <= found.compared.gain_ci95_m[1]
    assert found.compared.twin_m != found.twin_m, "each version brings its own twin"
    assert {item.id for item in found.lineage.inputs} == {"bar:1", f"bar:{drag.version}", scene_id}


def test_frames_that_are_scored_are_those_that_a_trace_holds_out() -> None:
    scene = tiny_scene(FRAMES)
    split = freeze(scene, 12, 3)
    assert scored_frames(scene, 1, "held_out") == slice(*split.test) != scored_frames(scene, 1, "all")
    assert scored_frames(scene, split.test[0] + 2, "held_out").start == split.test[0] + 2
    undeclared = replace(scene, test=(0, 0))
    assert scored_frames(undeclared, 1, "held_out") == slice(*freeze(undeclared, 12, 3).test)
    with pytest.raises(SceneUnsupported, match="no frame can be scored"):
        scored_frames(scene, FRAMES, "held_out")
