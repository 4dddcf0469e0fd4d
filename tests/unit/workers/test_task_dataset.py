"""The dataset's own tasks: baselines, the card with its pictures, rejected tries, strengths of a trace's effects."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError
from tiny_scene import register, tiny_scene

from physworld.effects.registry import effect
from physworld_schemas.dataset import Dataset, DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.trace import FoundEffect, TraceCreate
from physworld_storage import resources
from physworld_storage.database import open_database
from physworld_storage.jobs import jobs, leases
from physworld_storage.settings import Settings
from physworld_storage.tables import TraceRow
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores
from physworld_workers.tasks.dataset import strength_ranges
from physworld_workers.tasks.inputs import named, npz_bytes, twin_of

pytestmark = pytest.mark.slow

FIT = FitConfig(particle_budget=60, max_simulations=6)


def drain(runtime: Runtime) -> None:
    while True:
        with runtime.database.reading() as session:
            waiting = leases.publishable(session)
        if not waiting:
            return
        for publication in waiting:
            run_shard(runtime, publication.shard_id)


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtime]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("datasets") / "data", lease_seconds=5.0)
    database = open_database(settings)
    database.upgrade()
    yield Runtime(settings, database, Stores(settings, database), process_owner())
    database.dispose()


@pytest.fixture(scope="module")
def stores(runtime: Runtime) -> Stores:
    return runtime.stores


@pytest.fixture(scope="module")
def scene_id(stores: Stores) -> str:
    return register(tiny_scene(), stores.database, stores.artifacts)


@pytest.fixture(scope="module")
def fit_id(runtime: Runtime, scene_id: str) -> str:
    with runtime.database.session() as session:
        job = jobs.create_fit(session, scene_id, FIT)
    drain(runtime)
    return job.outputs[0].id


def make(
    runtime: Runtime, fit_id: str, *, trace_id: str | None = None, **config: object
) -> tuple[Job, Dataset]:
    settings = {"episodes": 3, "frames": 8, **config}
    with runtime.database.session() as session:
        job = jobs.create_dataset(session, fit_id, DatasetConfig.model_validate(settings), trace_id)
    drain(runtime)
    with runtime.database.reading() as session:
        return jobs.get_job(session, job.id), resources.get_dataset(session, job.outputs[0].id)


def attributes_of(stores: Stores, dataset: Dataset) -> list[dict]:
    assert dataset.digest is not None
    return [attributes for _, _, attributes in stores.episodes.iterate(dataset.digest)]


def test_the_card_says_what_is_covered_and_shows_it(runtime: Runtime, fit_id: str, stores: Stores) -> None:
    _, dataset = make(runtime, fit_id)

    def content(name: str) -> bytes:
        return stores.artifacts.read_bytes(named(dataset.artifacts, name, dataset.id).sha256)

    card = json.loads(content("card.json"))
    assert card["digest"] == dataset.digest and card["dataset_id"] == dataset.id
    assert sum(card["motions"].values()) == card["episodes"] == 3
    assert card["config"]["perturbation"] == "p3"
    places = np.concatenate(
        [arrays["particles"].reshape(-1, 3) for _, arrays, _ in stores.episodes.iterate(str(dataset.digest))]
    )
    low, high = np.array(card["workspace"]["min_m"]), np.array(card["workspace"]["max_m"])
    assert np.all(low >= places.min(axis=0) - 1e-6) and np.all(high <= places.max(axis=0) + 1e-6)
    assert 0.0 < card["workspace"]["occupancy"] <= 1.0
    means = [one["log_modulus_mean"] for one in attributes_of(stores, dataset)]
    figures = card["figures"]["log_modulus_mean"]
    assert figures["p0"] == pytest.approx(min(means), abs=1e-6)
    assert figures["p100"] == pytest.approx(max(means), abs=1e-6)
    picture = Image.open(io.BytesIO(content("coverage.png")))
    assert min(picture.size) > 400 and len(np.unique(np.asarray(picture.convert("L")))) > 20
    drawing = ElementTree.fromstring(content("coverage.svg"))
    assert drawing.tag.endswith("svg") and len(list(drawing.iter())) > 100


def test_the_same_dataset_has_the_same_pictures(runtime: Runtime, fit_id: str, stores: Stores) -> None:
    digests = []
    for _ in range(2):
        _, dataset = make(runtime, fit_id, seed=3)
        digests.append([named(dataset.artifacts, f"coverage.{kind}", "").sha256 for kind in ("svg", "png")])
    assert digests[0] == digests[1]


@pytest.mark.parametrize("kind", ["uniform", "random", "none"])
def test_a_baseline_of_the_perturbation_is_a_setting(
    runtime: Runtime, fit_id: str, stores: Stores, kind: str
) -> None:
    _, dataset = make(runtime, fit_id, perturbation=kind, episodes=2)
    for _, arrays, _ in stores.episodes.iterate(str(dataset.digest)):
        stiffness = arrays["properties"][:, 0]
        assert bool(np.ptp(stiffness) > 0) == (kind == "random")
        assert bool(np.any(stiffness != 0)) == (kind != "none")


def test_a_baseline_of_the_motion_is_a_setting(runtime: Runtime, fit_id: str, stores: Stores) -> None:
    _, dataset = make(runtime, fit_id, motion="linear", replay_share=0.0)
    assert dataset.statistics["motions"] == {"linear": 3}


def test_a_mix_that_the_scene_does_not_allow_is_refused_before_the_first_episode(
    runtime: Runtime, fit_id: str
) -> None:
    job, dataset = make(runtime, fit_id, patterns={"hold_one": 1.0}, replay_share=0.0)
    assert (job.state, dataset.state, dataset.episodes_done) == ("failed", "failed", 0)
    assert job.error is not None and job.error.code == "scene_unsupported"
    assert "this scene allows" in str(job.error.detail)


def test_features_that_the_scene_lacks_are_refused_before_the_first_episode(
    runtime: Runtime, fit_id: str
) -> None:
    job, dataset = make(runtime, fit_id, features="supplied")
    assert (job.state, dataset.episodes_done) == ("failed", 0)
    assert job.error is not None and "part_features" in str(job.error.detail)


def test_rejected_tries_are_counted_with_their_reasons_and_replaced(
    runtime: Runtime, fit_id: str, stores: Stores, monkeypatch: pytest.MonkeyPatch
) -> None:
    soften(runtime, fit_id, monkeypatch, 0.006)  # where it is softer than that, it sags out of the workspace
    job, dataset = make(
        runtime, fit_id, episodes=4, frames=30, tries=40, property_sigma=0.4, replay_share=0.0
    )
    assert job.state == "succeeded", job.error
    card = json.loads(stores.artifacts.read_bytes(named(dataset.artifacts, "card.json", dataset.id).sha256))
    attributes = attributes_of(stores, dataset)
    rejected = [one for own in attributes for one in own["rejected"]]
    assert len(rejected) == card["rejections"]["count"] == dataset.statistics["rejected_tries"]
    assert rejected, "this body is too stiff to reject anything: soften it more"
    assert sum(card["rejections"]["by_kind"].values()) == len(rejected)
    assert all(any(c.isdigit() for c in one["reason"]) for one in rejected)
    assert [one["episode"] for one in card["rejections"]["first"]] == [
        own["index"] for own in attributes for _ in own["rejected"]
    ]
    assert sum(own["tries"] for own in attributes) == 4 + len(rejected)


def test_an_episode_without_an_accepted_try_fails_the_dataset_with_its_reasons(
    runtime: Runtime, fit_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    soften(runtime, fit_id, monkeypatch, 1e-5)
    job, dataset = make(runtime, fit_id, episodes=1, frames=30, tries=3, replay_share=0.0)
    assert (job.state, dataset.state) == ("failed", "failed")
    assert job.error is not None and job.error.code == "episode_rejected"
    assert "all 3 tries were rejected (" in str(job.error.detail)


def soften(runtime: Runtime, fit_id: str, monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    """The fitted twin, as the tasks see it, with ``share`` of its stiffness."""
    twin = twin_of(runtime.stores, fit_id)
    modulus = twin.parameters["youngs_modulus_pa"]
    soft = twin.with_parameters(youngs_modulus_pa=share * modulus)
    monkeypatch.setattr("physworld_workers.tasks.dataset.twin_of", lambda *_: soft)


def found(name: str, **strengths: tuple) -> FoundEffect:
    parameters = {key: {"value": v, "unit": "1", "ci95": ci} for key, (v, ci) in strengths.items()}
    return FoundEffect.model_validate({"name": name, "parameters": parameters})


def test_strengths_of_a_trace_vary_within_their_intervals(
    runtime: Runtime, fit_id: str, scene_id: str, stores: Stores
) -> None:
    twin = twin_of(stores, fit_id).with_effect(effect("air_drag_linear", rate_per_s=2.0))
    artifact = stores.artifacts.put_bytes(npz_bytes(twin.to_arrays()), "twin.npz")
    number = {"value": 2.0, "unit": "1/s", "ci95": [1.5, 2.5]}
    with runtime.database.session() as session:
        job = jobs.create_trace(session, TraceCreate(scene_id=scene_id, fit=FIT))
        row = session.get_one(TraceRow, job.outputs[0].id)
        row.state, row.verdict, row.artifacts = "ready", "named", [artifact.model_dump()]
        effects = [{"name": "air_drag_linear", "parameters": {"rate_per_s": number}}]
        row.report = {"verdict": "named", "reason": "it fits best", "effects": effects}
        jobs.cancel_job(session, job.id)
        trace_id = row.id
    _, dataset = make(runtime, fit_id, trace_id=trace_id)
    rates = [own["effect_strengths"]["air_drag_linear.rate_per_s"] for own in attributes_of(stores, dataset)]
    assert len(set(rates)) == 3 and all(1.5 <= rate <= 2.5 for rate in rates)
    _, fixed = make(runtime, fit_id, trace_id=trace_id, effects="as_found")
    assert [own["effect_strengths"] for own in attributes_of(stores, fixed)] == [{}, {}, {}]


def test_strengths_without_a_value_or_an_interval_stay_as_they_are() -> None:
    effects = [
        found("wind", speed_x_m_s=(1.0, (0.5, 1.5)), speed_y_m_s=(0.0, None)),
        found("air_drag_linear", rate_per_s=(None, (0.0, 1.0))),
    ]
    ranges = strength_ranges(effects)
    assert [(one.effect, one.name, one.low, one.high) for one in ranges] == [
        ("wind", "speed_x_m_s", 0.5, 1.5)
    ]


def test_settings_that_are_no_mix_are_refused_on_the_wire() -> None:
    with pytest.raises(ValidationError, match="positive weight"):
        DatasetConfig(patterns={"lift": 0.0})
    with pytest.raises(ValidationError, match="wiggle"):
        DatasetConfig.model_validate({"patterns": {"wiggle": 1.0}})
    with pytest.raises(ValidationError, match="names a property twice"):
        DatasetConfig(properties=["density", "density"])
