"""A trace in real handlers: its simulations as helper shards, what it leaves, going on after a kill, and a cancel."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from tiny_scene import register, tiny_scene

from physworld.scene import Body, Grip
from physworld.trace import Memory
from physworld.trace import TraceConfig as LibraryConfig
from physworld.trace.preparation import Clock
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.trace import Trace, TraceConfig, TraceCreate
from physworld_storage import resources, traces
from physworld_storage.clock import CLOCK
from physworld_storage.jobs import helpers, jobs, leases
from physworld_storage.tables import JobRow, ShardRow, TraceRow, utc_now
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.housekeeping import remove_ended_scratch
from physworld_workers.stores import Stores
from physworld_workers.tasks import trace as task
from physworld_workers.tasks.inputs import named, npz_arrays, npz_bytes, twin_of

pytestmark = pytest.mark.slow

SMALL = TraceConfig(candidates=["air_drag_linear"], confirmed=1, iterations=1, resamples=100)
FIT = FitConfig(particle_budget=60, max_simulations=2, damping="none")


def _open(stores: Stores, scene_id: str) -> Job:
    with stores.database.session() as session:
        return jobs.create_trace(session, TraceCreate(scene_id=scene_id, fit=FIT, config=SMALL))


def _waiting(stores: Stores) -> list[str]:
    with stores.database.reading() as session:
        return [found.shard_id for found in leases.publishable(session)]


def _job(stores: Stores, job: Job) -> Job:
    with stores.database.reading() as session:
        return jobs.get_job(session, job.id)


def _trace(stores: Stores, job: Job) -> Trace:
    with stores.database.reading() as session:
        return traces.get_trace(session, job.outputs[0].id)


def _shards(stores: Stores, job: Job) -> list[ShardRow]:
    with stores.database.reading() as session:
        return session.query(ShardRow).where(ShardRow.job_id == job.id).all()


def test_a_trace_reports_shares_its_simulations_and_tidies_up(
    runtime_with: Callable[..., Runtime], stores: Stores, scene_id: str
) -> None:
    job = _open(stores, scene_id)
    (driver,) = _waiting(stores)
    assert run_shard(runtime_with(), driver) == "done"
    assert _job(stores, job).state == "succeeded"
    trace = _trace(stores, job)
    assert trace.state == "ready" and trace.verdict is not None and trace.scene == "tiny bar"
    assert trace.held_out is not None and trace.held_out["before"] > 0
    page = stores.artifacts.read_bytes(named(trace.artifacts, "report.html", trace.id).sha256)
    assert page.startswith(b"<!doctype html>") and trace.verdict.replace("_", " ").encode() in page.lower()
    data = stores.artifacts.read_bytes(named(trace.artifacts, "tracks.npz", trace.id).sha256)
    tracks = npz_arrays(data)
    assert tracks["before"].shape == tracks["after"].shape == (len(tracks["times"]), 4, 3)
    helped = [shard for shard in _shards(stores, job) if shard.kind == helpers.SIMULATION]
    assert len(helped) > 3 and {shard.state for shard in helped} == {"DONE"}
    assert trace.simulations is not None and trace.simulations >= len(helped)
    assert stores.scratch.jobs() == []


def test_a_trace_of_several_recordings_reports_on_each(
    runtime_with: Callable[..., Runtime], stores: Stores, scene_id: str
) -> None:
    others = [register(replace(tiny_scene(), name=name), stores.database, stores.artifacts) for name in "bc"]
    with stores.database.session() as session:
        request = TraceCreate(
            scene_id=scene_id, scene_ids=others[:1], held_out_scene_ids=others[1:], fit=FIT, config=SMALL
        )
        job = jobs.create_trace(session, request)
    (driver,) = _waiting(stores)
    assert run_shard(runtime_with(), driver) == "done"
    trace = _trace(stores, job)
    assert [(r["scene"], r["role"]) for r in trace.recordings] == [
        ("tiny bar", "fitted"), ("b", "fitted"), ("c", "held_out"),
    ]  # fmt: skip
    assert trace.scene_ids == others[:1] and trace.held_out_scene_ids == others[1:]
    assert trace.held_out is not None and trace.held_out["before"] == trace.recordings[2]["before"]
    assert [item.id for item in trace.lineage.inputs] == [scene_id, *others]
    data = stores.artifacts.read_bytes(named(trace.artifacts, "tracks.npz", trace.id).sha256)
    assert {"before", "before_0", "after_1", "after_2"} <= set(npz_arrays(data))


def test_a_killed_trace_goes_on_without_repeating_simulations(
    runtime_with: Callable[..., Runtime], stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = _open(stores, scene_id)
    (driver,) = _waiting(stores)
    keys: list[str] = []
    put = task.SharedMemory.put

    class Killed(BaseException):
        pass

    def dying(self: Memory, key: str, tracks: np.ndarray | None) -> None:
        put(self, key, tracks)
        keys.append(key)
        if len(set(keys)) == 5:
            raise Killed

    monkeypatch.setattr(task.SharedMemory, "put", dying)
    with pytest.raises(Killed):
        run_shard(runtime_with(), driver)
    assert stores.scratch.jobs() == [job.id]
    before = set(keys)
    keys.clear()
    monkeypatch.setattr(
        task.SharedMemory, "put", lambda self, key, tracks: (keys.append(key), put(self, key, tracks))
    )
    with stores.database.session() as session:
        session.info[CLOCK] = lambda: datetime.now(UTC) + timedelta(minutes=5)
        leases.reap(session)
    assert run_shard(runtime_with(), driver) == "done"
    assert not before & set(keys), "a simulation was run again"
    assert _trace(stores, job).state == "ready"
    assert {s.state for s in _shards(stores, job)} <= {"DONE", "CANCELLED"}


def test_a_cancelled_trace_stops_at_its_next_simulation(
    runtime_with: Callable[..., Runtime], stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = _open(stores, scene_id)
    (driver,) = _waiting(stores)
    put_up = helpers.put_up

    def cancelled_meanwhile(*arguments: object) -> list[str]:
        shards = put_up(*arguments)  # type: ignore[arg-type]
        jobs.cancel_job(arguments[0], job.id)  # type: ignore[arg-type]
        return shards

    monkeypatch.setattr(helpers, "put_up", cancelled_meanwhile)
    assert run_shard(runtime_with(), driver) == "cancelled"
    assert _job(stores, job).state == "cancelled"
    assert _trace(stores, job).state == "cancelled"
    assert {s.state for s in _shards(stores, job)} == {"CANCELLED"}
    assert stores.scratch.jobs() == []


def test_a_trace_whose_time_is_up_calls_off_what_it_has_asked_for(
    runtime_with: Callable[..., Runtime], stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # with a noise below what the model errs there is something to search for
    limited = SMALL.model_copy(update={"time_limit_s": 3600.0, "noise_m": 1e-6})
    with stores.database.session() as session:
        job = jobs.create_trace(session, TraceCreate(scene_id=scene_id, fit=FIT, config=limited))
    (driver,) = _waiting(stores)
    put_up, clock, asked = helpers.put_up, time.perf_counter, []

    def an_hour_later(*arguments: object) -> list[str]:
        shards = put_up(*arguments)  # type: ignore[arg-type]
        asked.append(len(shards))
        monkeypatch.setattr(time, "perf_counter", lambda: clock() + 3600.0)
        return shards

    start = Clock.start

    def searching(own: Clock) -> None:
        start(own)
        monkeypatch.setattr(helpers, "put_up", an_hour_later)

    monkeypatch.setattr(Clock, "start", searching)
    assert run_shard(runtime_with(), driver) == "done"
    assert _job(stores, job).state == "succeeded"
    found = _trace(stores, job)
    assert len(asked) == 1 and asked[0] > 1
    assert found.verdict == "unexplained" and "searches were left" in (found.reason or "")
    states = [shard.state for shard in _shards(stores, job)]
    assert states.count("CANCELLED") == asked[0] and set(states) == {"DONE", "CANCELLED"}


def test_what_an_ended_job_left_in_the_scratch_is_swept(stores: Stores, scene_id: str) -> None:
    running, ended, failed, forgotten = (_open(stores, scene_id) for _ in range(4))
    with stores.database.session() as session:
        jobs.cancel_job(session, ended.id)
        for job, days in ((failed, 6), (forgotten, 8)):
            row = session.get_one(JobRow, job.id)
            row.state, row.finished_at = "failed", utc_now() - timedelta(days=days)
    for job_id in (running.id, ended.id, failed.id, forgotten.id, "job_nobody"):
        stores.scratch.put(job_id, "x.npy", b"1")
    swept = remove_ended_scratch(stores.scratch, stores.database)
    assert sorted(swept) == sorted([ended.id, forgotten.id, "job_nobody"])
    assert sorted(stores.scratch.jobs()) == sorted([running.id, failed.id])


def test_a_dataset_comes_from_the_twin_with_the_added_effect(
    runtime_with: Callable[..., Runtime], stores: Stores, scene_id: str
) -> None:
    from physworld.effects.registry import effect

    with stores.database.session() as session:
        made = jobs.create_fit(session, scene_id, FIT)
    run_shard(runtime_with(), _waiting(stores)[0])
    fit_id = made.outputs[0].id
    with_drag = twin_of(stores, fit_id).with_effect(effect("air_drag_linear", rate_per_s=1.5))
    artifact = stores.artifacts.put_bytes(npz_bytes(with_drag.to_arrays()), "twin.npz")
    job = _open(stores, scene_id)
    trace_id = job.outputs[0].id
    for verdict, left, effects in (
        ("named", [artifact.model_dump()], 1),
        ("equivalent_set", [artifact.model_dump()], 1),
        ("equivalent_set", [], 0),
    ):
        with stores.database.session() as session:
            row = session.get_one(TraceRow, trace_id)
            row.state, row.verdict, row.artifacts = "ready", verdict, left
        fresh = Stores(stores.settings, stores.database)
        twin: Twin = twin_of(fresh, fit_id, trace_id)
        assert len(twin.effects) == effects
    with stores.database.session() as session:
        opened = jobs.create_dataset(session, fit_id, DatasetConfig(episodes=1), trace_id)
        assert [item.kind for item in opened.inputs] == ["fit", "trace"]
        assert resources.get_dataset(session, opened.outputs[0].id).trace_id == trace_id


def test_a_service_traces_as_the_library_does_unless_it_is_told_otherwise() -> None:
    asked = TraceCreate(scene_id="scn_a")
    assert task.translate(asked.fit, asked.config, "cpu") == LibraryConfig()


@pytest.mark.parametrize(
    ("changed", "law", "taken"),
    [
        ({"law": "hencky"}, {}, False),
        ({"plasticity": "von_mises"}, {}, False),
        ({"mesh": "4x4"}, {}, False),
        ({}, {}, True),
        ({}, {"membrane_n_m": 3e3, "bending_n_m": 3e3 * 4e-4**2 / 12, "bending_twist_ratio": 2.0}, True),
        ({}, {"bending_coupling": 0.5}, False),
        ({}, {"bending_n_m": 1e-3}, False),
    ],
)
def test_a_fit_whose_physics_is_not_the_declared_one_is_calibrated_anew(
    stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch, changed: dict, law: dict, taken: bool
) -> None:
    config = FIT.model_copy(update=changed)
    with stores.database.session() as session:
        fit_id = jobs.create_fit(session, scene_id, config).outputs[0].id
    scene = tiny_scene()
    if law:
        plane = np.stack(np.meshgrid(*[np.linspace(0, 0.2, 3)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
        still = np.repeat(np.concatenate([plane, np.zeros((9, 1))], axis=1)[None], len(scene.times), axis=0)
        body = Body(thickness_m=4e-4)
        scene = replace(
            scene, kind="sheet", points=still, visible=np.ones(still.shape[:2], dtype=bool), body=body
        )
        scene = replace(scene, grips=())
    twin = build_twin(scene, FIT.particle_budget).with_parameters(**law)
    monkeypatch.setattr(task, "twin_of", lambda stores, fit_id: twin)
    assert (task._undamped_twin(stores, fit_id, FIT, scene_id) is twin) is taken


def test_a_trace_begins_with_the_fit_of_another_recording_in_its_own_body(
    runtime_with: Callable[..., Runtime], stores: Stores, scene_id: str
) -> None:
    shift = np.array([0.3, 0.0, 0.1])
    scene = tiny_scene()
    low, high = np.array([0.0, -0.015, -0.015]), np.array([0.12, 0.015, 0.015])
    held = Grip((0, 1, 2, 3), low + shift, np.array([0.02, 0.015, 0.015]) + shift)
    moved = replace(
        scene,
        points=scene.points + shift,
        controllers=scene.controllers + shift,
        body=Body(box_min_m=low + shift, box_max_m=high + shift, density_kg_m3=300.0),
        grips=(held,),
    )
    other = register(moved, stores.database, stores.artifacts)
    with stores.database.session() as session:
        fit_id = jobs.create_fit(session, scene_id, FIT).outputs[0].id
    (fitting,) = _waiting(stores)
    assert run_shard(runtime_with(), fitting) == "done"
    home, placed = twin_of(stores, fit_id), task._undamped_twin(stores, fit_id, FIT, other)
    assert placed is not None and placed.parameters == home.parameters
    offset = placed.body.start.mean(axis=0) - home.body.start.mean(axis=0)
    np.testing.assert_allclose(offset, shift, atol=1e-3)
    with stores.database.session() as session:
        request = TraceCreate(scene_id=other, fit_id=fit_id, fit=FIT, config=SMALL)
        job = jobs.create_trace(session, request)
    (driver,) = _waiting(stores)
    assert run_shard(runtime_with(), driver) == "done"
    trace = _trace(stores, job)
    assert (trace.state, trace.scene_id, trace.fit_id) == ("ready", other, fit_id)
    stages = [stage["name"] for stage in (trace.model_extra or {})["stages"]]
    assert "declared physics" in stages and "calibration" not in stages, "the fit's parameters are taken"
