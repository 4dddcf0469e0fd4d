"""Loops on the pages: the chain of a model's versions with their errors, the job and its stages, the form."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from dashboard_served import Served, demonstrated, from_page, work
from tiny_scene import register, tiny_scene

from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.loop import LoopCreate
from physworld_schemas.model import TrainingCreate
from physworld_services.stores import Stores
from physworld_storage.database import Database
from physworld_storage.jobs import jobs, leases

pytestmark = pytest.mark.slow

TWIN = {"name": "twin.npz", "sha256": "0" * 64, "size": 3}
FIGURE = {"error_m": 2e-3, "ci95_m": [1e-3, 3e-3], "noise_floor_m": 1e-4, "frames": 10}
EFFECT = {"name": "air_drag_linear", "parameters": {"rate_per_s": {"value": 2.0, "unit": "1/s"}}}


class World:
    """A model of the tiny scene with one version, a new recording, and a hand that does the work."""

    def __init__(self, database: Database, stores: Stores) -> None:
        self.database = database
        self.home = register(tiny_scene(), database, stores.artifacts)
        self.recording = register(tiny_scene(frames=24), database, stores.artifacts)
        self.verdict = "named"
        with database.session() as session:
            fit = jobs.create_fit(session, self.home, FitConfig())
        self.work()
        with database.session() as session:
            made = jobs.create_dataset(session, fit.outputs[0].id, DatasetConfig(episodes=1))
        self.work()
        with database.session() as session:
            jobs.create_training(session, TrainingCreate(name="bar", dataset_id=made.outputs[0].id))
        self.work()

    def loop(self) -> Job:
        with self.database.session() as session:
            return jobs.create_loop(session, LoopCreate(model="bar", version=1, scene_id=self.recording))

    def work(self, most: int | None = None) -> None:
        work(self.database, self._result, most)

    def _result(self, lease: leases.Lease) -> dict[str, Any]:
        answer = {
            "outcome": "worse_than_expected", "reason": "it errs", "measured": FIGURE, "expected": FIGURE,
            "excess_m": 0.0, "excess_ci95_m": [0.0, 0.0], "start_mismatch_m": 0.0, "twin_m": 1e-3,
            "baselines_m": {"static": 0.0777, "rigid_follow": None, "constant_velocity": 0.0888},
        }  # fmt: skip
        if lease.kind == "assessment" and lease.payload["compared"] is not None:
            other = {"version": 1, "measured": {**FIGURE, "error_m": 5.55e-3}, "twin_m": 4e-3}
            answer["compared"] = {**other, "gain_m": 3.55e-3, "gain_ci95_m": [3e-3, 4e-3]}
        files = [TWIN] if self.verdict == "named" else []
        return {
            **demonstrated(lease),
            "fit": {"parameters": {}, "metrics": {}, "artifacts": [TWIN]},
            "training": {"artifacts": [], "sha256": "c" * 64, "metrics": {}},
            "trace": {
                "verdict": self.verdict, "report": {"reason": "so", "effects": [EFFECT]}, "artifacts": files,
            },
            "assessment": answer,
        }[lease.kind]  # fmt: skip


@pytest.fixture
def shown(dashboard: Served) -> tuple[World, httpx.Client]:
    return World(dashboard.database, dashboard.stores), dashboard.client


def test_the_page_of_a_model_shows_the_chain_of_versions_with_their_errors(
    shown: tuple[World, httpx.Client],
) -> None:
    world, client = shown
    assert "From version to version" not in client.get("/dashboard/models/bar").text
    job = world.loop()
    assert "From version to version" in client.get("/dashboard/models/bar").text, "a loop that runs is there"
    world.work()
    page = client.get("/dashboard/models/bar").text
    for text in ("5.55", "2.00", "77.7", "88.8", "air drag linear", "improved", "tiny bar, version 1"):
        assert text in page, text
    for place in (f"/scenes/{world.recording}", f"/jobs/{job.id}", "/models/bar/2", "/traces/"):
        assert f'href="/dashboard{place}' in page, place


def test_a_loop_that_ends_without_a_version_says_why(shown: tuple[World, httpx.Client]) -> None:
    world, client = shown
    world.verdict = "nothing_to_explain"
    job = world.loop()
    world.work()
    page = client.get("/dashboard/models/bar").text
    assert "no effect" in page and "nothing to explain" in page and "version 2" not in page
    assert (
        "The trace supports no effect (nothing_to_explain): so"
        in client.get(f"/dashboard/jobs/{job.id}").text
    )
    listed = client.get("/dashboard/").text.partition(job.id)[2].partition("</li>")[0]
    assert "<span>Trace</span>" in listed and "<span>Training</span>" not in listed


def test_the_page_of_a_loop_shows_its_stages_and_theirs_lead_back(shown: tuple[World, httpx.Client]) -> None:
    world, client = shown
    job = world.loop()
    assert "<span>Training</span>" in client.get("/dashboard/").text, "what may follow is shown as waiting"
    world.work(1)
    page = client.get(f"/dashboard/jobs/{job.id}").text
    assert ">Assessment</a>" in page and ">Trace</a>" in page
    with world.database.reading() as session:
        child = jobs.get_job(session, job.id).children[0]
    assert f'<a href="/dashboard/jobs/{job.id}">loop</a>' in client.get(f"/dashboard/jobs/{child}").text


def test_a_loop_is_started_from_a_form_and_again_with_other_settings(
    shown: tuple[World, httpx.Client],
) -> None:
    world, client = shown
    own = from_page(client)
    asked = {"model": "bar", "version": "1", "scene_id": world.recording, "trace.seed": "5"}
    answer = client.post("/dashboard/start/loop", data=asked, headers=own)
    assert answer.status_code == 303, answer.text
    with world.database.reading() as session:
        (job,) = jobs.list_jobs(session, kind="loop").data
    assert (job.config["trace"]["seed"], job.config["dataset"]) == (5, None)
    again = client.get(f"/dashboard/start/loop?job={job.id}").text
    assert world.recording in again and 'value="5"' in again
    refused = client.post("/dashboard/start/loop", data={**asked, "scene_id": world.home}, headers=own)
    assert refused.status_code == 409 and "needs another one" in refused.text
