"""Rollouts and plans from the SDK and the command line, with a real model, its twin, and workers in the test."""

from __future__ import annotations

import asyncio
import html
import io
import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from inference_serving import Served, serve_inference
from physworld_client import AsyncClient, Client, InvalidRequest
from physworld_client.cli.app import app
from published_tiny import tiny_model
from typer.testing import CliRunner

from physworld_schemas.plan import PlanConfig, PlanLimits
from physworld_schemas.rollout import SYNC_STEPS
from physworld_storage.jobs import leases
from physworld_workers.execute import Runtime, run_shard

SINGLE_PRECISION_M = 2e-6
SMALL = PlanConfig(horizon=12, samples=24, iterations=3)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The service, and a worker for its inference queue in a thread."""
    with serve_inference(tmp_path_factory.mktemp("data")) as served:
        runtime = Runtime(served.settings, served.database, served.stores, "test")
        over = threading.Event()

        def work() -> None:
            while not over.wait(0.1):
                with served.database.session() as session:
                    waiting = leases.publishable(session)
                    leases.mark_published(session, waiting)
                for publication in waiting:
                    run_shard(runtime, publication.shard_id)

        thread = threading.Thread(target=work)
        thread.start()
        yield served
        over.set()
        thread.join()


@pytest.fixture
def client(served: Served) -> Iterator[Client]:
    with Client(served.url, served.token) as client:
        yield client


def paths(count: int, ticks: int = 16) -> np.ndarray:
    model = tiny_model()[2]
    past = model.start_controllers
    drift = np.linspace(0.0, 0.02, ticks - len(past))[:, None, None] * np.array([0.0, 1.0, 1.0])
    path = np.concatenate([past, past[-1] + drift])
    return np.repeat(path[None].astype(np.float32), count, axis=0)


def test_a_rollout_comes_back_as_arrays(served: Served, client: Client) -> None:
    model = tiny_model()[2]
    found = client.rollouts.create(
        served.model, paths(2), dt_s=model.spec.dt_s, returns=["points", "vertices"]
    )
    expected = model.rollout_batch(paths(2).astype(float))
    assert found.vertices == pytest.approx(expected, abs=SINGLE_PRECISION_M)
    assert found.points == pytest.approx(model.skin.apply(expected), abs=SINGLE_PRECISION_M)
    assert found.times == pytest.approx(np.arange(16) * model.spec.dt_s)
    assert found.rollout.id is None


def test_a_large_batch_is_waited_for_and_is_the_same(served: Served, client: Client) -> None:
    batch = paths(SYNC_STEPS // 16 + 1)
    found = client.rollouts.create(served.model, batch, timeout=120)
    assert found.rollout.id is not None
    assert found.points is not None
    alone = client.rollouts.create(served.model, batch[0])
    assert found.points[-1] == pytest.approx(alone.points[0], abs=SINGLE_PRECISION_M)
    assert client.rollouts.list(model=served.model).data[0].id == found.rollout.id


def test_the_dashboard_shows_the_job_and_gives_its_arrays(served: Served, client: Client) -> None:
    found = client.rollouts.create(served.model, paths(1), as_job=True, timeout=120)
    with httpx.Client(base_url=served.url, follow_redirects=True, trust_env=False) as browser:
        origin = {"Origin": served.url}
        browser.post("/dashboard/login", data={"key": served.token, "next": "/dashboard/"}, headers=origin)
        job = browser.get(f"/dashboard/jobs/{found.rollout.job_id}", headers={"Accept": "text/html"}).text
        rollout = re.search(r'href="(/dashboard/rollouts/rol_[^"/]+)"', job)
        assert rollout is not None
        page = browser.get(rollout.group(1), headers={"Accept": "text/html"}).text
        link = re.search(r'href="(/dashboard/artifacts/[^"]+\.npz)"', page)
        assert link is not None
        data = browser.get(html.unescape(link.group(1))).content
        playground = browser.get(f"/dashboard/models/{served.model}/1/playground").text
    with np.load(io.BytesIO(data)) as arrays:
        assert np.array_equal(arrays["points"], found.points)
    assert "data-playground" in playground


def test_the_asynchronous_client_predicts_the_same(served: Served, client: Client) -> None:
    async def ask() -> np.ndarray:
        async with AsyncClient(served.url, served.token) as other:
            found = await other.rollouts.create(served.model, paths(1), as_job=True, timeout=120)
            assert found.points is not None
            return found.points

    expected = client.rollouts.create(served.model, paths(1)).points
    assert asyncio.run(ask()) == pytest.approx(expected, abs=SINGLE_PRECISION_M)


def test_a_refusal_names_what_is_wrong(served: Served, client: Client) -> None:
    with pytest.raises(InvalidRequest, match="4 of them"):
        client.rollouts.create(served.model, paths(1)[:, :, :2])


def test_a_plan_is_made_checked_in_the_twin_and_rolled_out_again(served: Served, client: Client) -> None:
    start = tiny_model()[2].skin.apply(tiny_model()[2].start_history[-1])
    goal = {len(start) - 1: start[-1] + [0.0, 0.015, 0.01]}
    job = client.plans.create(served.model, points=goal, config=SMALL, limits=PlanLimits(speed_m_s=0.3))
    client.jobs.wait(job, 180)
    found = client.plans.result(job.outputs[0].id)
    plan = found.plan
    assert plan.executed_error_m < plan.motionless_error_m
    assert plan.predicted_error_m <= plan.motionless_error_m
    assert plan.peak_speed_m_s <= 0.3 + 1e-9
    assert plan.cost_history == sorted(plan.cost_history, reverse=True)
    assert plan.lineage.seeds == {"plan": 0}
    assert {item.kind for item in plan.lineage.inputs} == {"model", "scene", "fit"}
    again = client.rollouts.create(served.model, found.controllers)
    ticks = len(found.arrays["times"])
    assert again.points[0, -ticks:] == pytest.approx(found.arrays["predicted"], abs=1e-4)
    assert client.plans.list().data[0].id == plan.id


def test_a_shape_is_a_goal_too_and_nonsense_is_refused(served: Served, client: Client) -> None:
    start = tiny_model()[2].start_history[-1]
    shape = tiny_model()[2].skin.apply(start) + np.array([0.0, 0.01, 0.0])
    job = client.plans.create(served.model, shape=shape, config=SMALL)
    client.jobs.wait(job, 180)
    assert client.plans.get(job.outputs[0].id).goal == "shape"
    with pytest.raises(InvalidRequest, match="4 points"):
        client.plans.create(served.model, points={99: [0.0, 0.0, 0.0]}, config=SMALL)
    with pytest.raises(InvalidRequest, match="finite"):
        client.plans.create(served.model, shape=np.full((3, 3), np.nan), config=SMALL)
    with pytest.raises(TypeError):
        client.plans.create(served.model)
    goal = {"kind": "points", "index": [3], "places": [[0.1, 0.0, 0.0]]}
    limits = {"workspace_min_m": [0.01, -0.1, -0.1]}
    beside = client.http.post("/v1/plans", json={"model": served.model, "goal": goal, "limits": limits})
    assert beside.status_code == 422
    assert "[0.01, -0.1, -0.1] to [0.0, 0.0, 0.0] leaves out the start" in beside.json()["detail"]


def test_the_commands_write_what_the_service_answers(served: Served, tmp_path: Path) -> None:
    place = ["--url", served.url, "--token", served.token, "--json"]
    controls, out = tmp_path / "controls.npz", tmp_path / "out" / "rollout.npz"
    np.savez(controls, controllers=paths(1)[0])
    options = ["--controllers", str(controls), "--out", str(out), "--vertices"]
    ran = CliRunner().invoke(app, ["rollout", served.model, *options, *place])
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout[ran.stdout.index("{\n") :])["candidates"] == 1
    with np.load(out) as arrays:
        assert arrays["points"].shape[:2] == (1, 16)
        assert arrays["vertices"].shape[:2] == (1, 16)

    experiment = tmp_path / "report.json"
    times = (np.arange(16) / 60.0).tolist()
    suggested = {"times_s": times, "controllers": paths(1)[0].tolist(), "motion": "lift"}
    experiment.write_text(json.dumps({"suggested_experiment": suggested}))
    options = ["--controllers", str(experiment), "--out", str(out), "--rest"]
    ran = CliRunner().invoke(app, ["rollout", served.model, *options, *place])
    assert ran.exit_code == 0, ran.output
    with np.load(out) as arrays:
        assert arrays["points"].shape[1] == 9  # 0.25 s at 30 a second

    goal, plan = tmp_path / "goal.npz", tmp_path / "plan.npz"
    np.savez(goal, index=np.array([3]), places=np.array([[0.12, 0.01, 0.02]]))
    options = [
        "--goal",
        str(goal),
        "--out",
        str(plan),
        "--horizon",
        "8",
        "--samples",
        "8",
        "--iterations",
        "2",
    ]
    ran = CliRunner().invoke(app, ["plan", served.model, *options, *place])
    assert ran.exit_code == 0, ran.output
    with np.load(plan) as arrays:
        assert arrays["controllers"].shape[0] == 3 + 8
