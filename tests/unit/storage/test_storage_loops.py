"""Loops in the database: what follows what, where each ends, what is refused, and what the wire is told."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from pydantic import ValidationError

from physworld_schemas.assessment import AssessmentCreate
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.loop import Loop, LoopCreate
from physworld_schemas.model import TrainingConfig, TrainingCreate
from physworld_schemas.scene import Scene
from physworld_storage import loops, registry, removal
from physworld_storage.database import Database
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.jobs import jobs, leases
from physworld_storage.tables import FitRow, SceneRow, ShardRow, TraceRow

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from conftest import Work

TWIN = {"name": "twin.npz", "sha256": "0" * 64, "size": 3}
FIGURE = {"error_m": 2e-3, "ci95_m": [1e-3, 3e-3], "noise_floor_m": 1e-4, "frames": 10}
EFFECT = {"name": "air_drag_linear", "parameters": {"rate_per_s": {"value": 2.0, "unit": "1/s"}}}
SETTINGS = DatasetConfig(episodes=1, seed=7)
TRAINING = TrainingConfig(steps=11)
WHOLE = ["assessment", "trace", "dataset", "training", "assessment"]


class Turns:
    """A model with one version, and a worker that answers as it is told."""

    def __init__(self, work: Work, database: Database) -> None:
        self.work, self.database = work, database
        self.verdict, self.outcome, self.gain = "named", "worse_than_expected", (1e-3, 2e-3)
        self.home = work.scene("home")
        fit = self.finish(self.opened(lambda s: jobs.create_fit(s, self.home.id, FitConfig())))
        made = self.finish(self.opened(lambda s: jobs.create_dataset(s, fit.outputs[0].id, SETTINGS)))
        asked = TrainingCreate(name="bar", dataset_id=made.outputs[0].id, config=TRAINING)
        self.finish(self.opened(lambda s: jobs.create_training(s, asked)))

    def opened(self, create: Any) -> Job:
        with self.database.session() as session:
            job: Job = create(session)
            return job

    def open(self, scene: Scene, **more: Any) -> Job:
        request = LoopCreate(model="bar", scene_id=scene.id, **more)
        return self.opened(lambda session: jobs.create_loop(session, request))

    def step(self) -> leases.Lease:
        lease = self.work.claim()
        with self.database.session() as session:
            assert leases.complete(session, lease, self._result(lease))
        return lease

    def finish(self, job: Job) -> Job:
        while self.work.job(job).state in {"queued", "running"}:
            self.step()
        return self.work.job(job)

    def loop(self, job: Job) -> Loop:
        with self.database.reading() as session:
            return loops.get_loop(session, job.id)

    def kinds(self, job: Job) -> list[str]:
        return [self.work.job(child).kind for child in self.work.job(job).children]

    def _result(self, lease: leases.Lease) -> dict[str, Any]:
        if lease.kind == "trace":
            artifacts = [TWIN] if self.verdict == "named" else []
            report = {"reason": "so it is", "effects": [EFFECT] if artifacts else []}
            return {"verdict": self.verdict, "report": report, "artifacts": artifacts}
        if lease.kind != "assessment":
            return self.work.result(lease)
        answer = {
            "outcome": self.outcome, "reason": "it errs", "measured": FIGURE, "expected": FIGURE, "excess_m": 0.0,
            "excess_ci95_m": [0.0, 0.0], "start_mismatch_m": 0.0, "baselines_m": {"static": 0.1}, "twin_m": 1e-3,
        }  # fmt: skip
        other = lease.payload["compared"]
        if other is not None:
            answer["compared"] = {
                "version": other["version"], "measured": {**FIGURE, "error_m": 5e-3}, "twin_m": 4e-3,
                "gain_m": 3e-3, "gain_ci95_m": list(self.gain),
            }  # fmt: skip
        return answer


@pytest.fixture
def turns(work: Work, database: Database) -> Turns:
    return Turns(work, database)


def test_a_supported_effect_ends_in_the_next_version_with_both_errors(turns: Turns) -> None:
    scene = turns.work.scene("new")
    job = turns.finish(turns.open(scene))
    assert turns.kinds(job) == WHOLE and job.progress.fraction == 1.0
    found = turns.loop(job)
    assert (found.outcome, found.verdict, found.version, found.new_version) == ("improved", "named", 1, 2)
    assert found.before is not None and found.after is not None
    assert (found.before.version, found.before.measured.error_m) == (1, 5e-3)
    assert (found.after.version, found.after.measured.error_m) == (2, 2e-3)
    assert found.baselines_m == {"static": 0.1} and found.effects[0].name == "air_drag_linear"
    assert "version 2 errs 2 mm, version 1 5 mm" in found.reason and "anew" not in found.reason
    with turns.database.reading() as session:
        version = registry.get_version(session, "bar", 2)
        trace = session.get_one(TraceRow, found.trace_id)
        (before, last) = [
            row.payload
            for row in session.query(ShardRow).where(ShardRow.kind == "assessment").order_by(ShardRow.id)
        ]
    assert (version.trace_id, version.scene_id) == (found.trace_id, turns.home.id)
    assert version.config == TRAINING and version.dataset_id == found.dataset_id
    assert (trace.scene_id, trace.report["scene_ids"]) == (turns.home.id, [scene.id])
    assert (before["frames"], before["compared"]) == ("all", None)
    assert (last["frames"], last["version"], last["compared"]["version"]) == ("held_out", 2, 1)
    assert last["trace_id"] == found.trace_id and last["compared"]["trace_id"] is None


def test_a_second_turn_keeps_what_the_first_one_saw(turns: Turns) -> None:
    first, second = turns.work.scene("new"), turns.work.scene("newer")
    turns.finish(turns.open(first))
    job = turns.finish(turns.open(second))
    found = turns.loop(job)
    assert (found.version, found.new_version) == (2, 3)
    assert found.reason.endswith("; the effects are those of version 2, estimated anew")
    with turns.database.reading() as session:
        trace = session.get_one(TraceRow, found.trace_id)
        assert trace.report["scene_ids"] == [first.id, second.id]
        listed = loops.list_loops(session, model="bar").data
        assert [one.id for one in listed] == [job.id, listed[1].id] and len(listed) == 2
        assert loops.list_loops(session, model="other").data == []
        assert loops.list_loops(session, state="failed").data == []


@pytest.mark.parametrize(
    "verdict", ["nothing_to_explain", "unexplained", "data_issue", "numerical_issue", "equivalent_set"]
)
def test_a_trace_without_an_effect_is_the_end(turns: Turns, verdict: str) -> None:
    turns.verdict = verdict
    job = turns.finish(turns.open(turns.work.scene("new")))
    found = turns.loop(job)
    assert (job.state, turns.kinds(job)) == ("succeeded", ["assessment", "trace"])
    assert (found.outcome, found.verdict, found.new_version) == ("no_effect", verdict, None)
    assert verdict in found.reason and found.effects == [] and found.before is None
    with turns.database.reading() as session:
        assert registry.get_model(session, "bar").latest_version == 1


def test_a_model_that_keeps_its_promise_is_left_alone(turns: Turns) -> None:
    turns.outcome = "as_expected"
    job = turns.finish(turns.open(turns.work.scene("new")))
    assert turns.kinds(job) == ["assessment"]
    found = turns.loop(job)
    assert (found.outcome, found.trace_id, found.reason) == ("as_expected", None, "it errs")


def test_a_version_that_is_no_better_is_called_that(turns: Turns) -> None:
    turns.gain = (-1e-3, 2e-3)
    found = turns.loop(turns.finish(turns.open(turns.work.scene("new"))))
    assert (found.outcome, found.new_version) == ("not_improved", 2)


def test_it_goes_on_from_an_assessment(turns: Turns) -> None:
    scene = turns.work.scene("new")
    held = turns.finish(turns.opened(lambda s: jobs.create_assessment(s, "bar", 1, _assess(scene))))
    known = next(item.id for item in held.outputs if item.kind == "assessment")
    request = LoopCreate(assessment_id=known)
    job = turns.finish(turns.opened(lambda s: jobs.create_loop(s, request)))
    assert turns.kinds(job) == WHOLE[1:]
    found = turns.loop(job)
    assert (found.assessment_id, found.scene_id, found.outcome) == (known, scene.id, "improved")
    turns.outcome = "within_noise"
    fine = turns.finish(turns.opened(lambda s: jobs.create_assessment(s, "bar", 1, _assess(scene))))
    with pytest.raises(Conflict, match="found nothing to close a loop on: it errs"):
        turns.opened(lambda s: jobs.create_loop(s, LoopCreate(assessment_id=fine.outputs[0].id)))


def _assess(scene: Scene) -> AssessmentCreate:
    return AssessmentCreate(scene_id=scene.id, open_trace=False)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kind": "sheet"}, "shows a sheet, version 1 of bar is of a beam"),
        ({"controllers": 2}, "has 2 controllers"),
    ],
)
def test_a_recording_of_another_object_is_refused(turns: Turns, changes: dict[str, Any], words: str) -> None:
    other = turns.work.scene("other")
    with turns.database.session() as session:
        for name, value in changes.items():
            setattr(session.get_one(SceneRow, other.id), name, value)
    with pytest.raises(Conflict, match=words):
        turns.open(other)
    with pytest.raises(Conflict, match="needs another one"):
        turns.open(turns.home)
    with pytest.raises(NotFound):
        turns.open(turns.home.model_copy(update={"id": "scn_none"}))


def test_a_fit_of_another_physics_is_refused_before_anything_runs(turns: Turns) -> None:
    with turns.database.session() as session:
        fit = session.query(FitRow).one()
        fit.config = {**fit.config, "stages": "global+local"}
    with pytest.raises(Conflict, match="cannot be traced"):
        turns.open(turns.work.scene("new"))
    assert turns.work.waiting() == []


@pytest.mark.parametrize("done", range(5))
def test_a_failed_loop_is_taken_up_where_it_was(turns: Turns, done: int) -> None:
    job = turns.open(turns.work.scene("new"))
    while len(turns.kinds(job)) <= done:
        turns.step()
    turns.work.fail(turns.work.claim(), retry=False, detail="a bug")
    failed = turns.loop(job)
    assert (failed.state, failed.outcome) == ("failed", None) and failed.error is not None
    turns.opened(lambda s: jobs.retry_job(s, job.id))
    assert turns.finish(job).state == "succeeded" and turns.kinds(job) == WHOLE
    assert turns.loop(job).outcome == "improved"


def test_a_cancelled_loop_ends_with_its_children(turns: Turns) -> None:
    job = turns.open(turns.work.scene("new"))
    turns.step()
    turns.work.cancel(job)
    assert [turns.work.job(child).state for child in turns.work.job(job).children] == [
        "succeeded",
        "cancelled",
    ]
    assert (turns.loop(job).state, turns.loop(job).outcome) == ("cancelled", None)


def test_progress_only_grows(turns: Turns) -> None:
    job = turns.open(turns.work.scene("new"))
    told = [0.0]
    while turns.work.job(job).state in {"queued", "running"}:
        turns.step()
        told.append(turns.work.job(job).progress.done)
    assert told == sorted(told) and told[-1] == 100.0


def test_a_loop_whose_comparison_was_deleted_is_still_told(turns: Turns) -> None:
    job = turns.finish(turns.open(turns.work.scene("new")))
    with turns.database.session() as session:
        removal.remove(session, "assessment", str(turns.loop(job).comparison_id))
        removal.remove(session, "assessment", str(turns.loop(job).assessment_id))
    found = turns.loop(job)
    assert (found.state, found.outcome, found.before, found.new_version) == ("succeeded", None, None, 2)


def test_a_loop_that_is_none_is_not_found(turns: Turns) -> None:
    plain = turns.work.fit()
    for known in (plain.id, "job_none"):
        with pytest.raises(NotFound), turns.database.reading() as session:
            loops.get_loop(session, known)


@pytest.mark.parametrize(
    "body",
    [
        {}, {"model": "bar"}, {"scene_id": "scn_1"}, {"assessment_id": "ass_1", "model": "bar"},
        {"assessment_id": "ass_1", "scene_id": "scn_1"}, {"assessment_id": "ass_1", "version": 2},
    ],
)  # fmt: skip
def test_a_loop_begins_with_a_recording_or_with_an_assessment(body: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="assessment_id"):
        LoopCreate(**body)
