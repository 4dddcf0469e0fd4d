"""A trace on the real service: broker, two workers, HTTP; its simulations shared, its end, a kill, a cancel."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import psutil
import pytest
from physworld_client import Client
from service_process import ServiceProcess, until
from tiny_scene import register, tiny_scene

from physworld_schemas.fit import FitConfig
from physworld_schemas.job import TERMINAL_STATES, Job
from physworld_schemas.trace import TraceConfig
from physworld_storage.jobs.helpers import SIMULATION
from physworld_storage.tables import ShardRow

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

FIT = FitConfig(particle_budget=60, max_simulations=2, damping="none")
SMALL = TraceConfig(candidates=["air_drag_linear", "gravity_tilt"], confirmed=1, iterations=1, resamples=100)
ENDS_WITHIN_S = 240.0


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    data = tmp_path_factory.mktemp("service") / "data"
    with ServiceProcess(data, "--workers", "2", "--no-trainer") as process:
        yield process.start()
        assert process.interrupt() == 0


@pytest.fixture(scope="module")
def client(service: ServiceProcess) -> Iterator[Client]:
    state = service.state()
    with Client(state["api_url"], Path(state["api_key_file"]).read_text().strip()) as client:
        yield client


@pytest.fixture(scope="module")
def scene_id(service: ServiceProcess) -> str:
    """The tiny scene, long enough that two workers meet."""
    database, stores = service.stores()
    made = register(tiny_scene(frames=45), database, stores.artifacts)
    database.dispose()
    return made


def simulations(service: ServiceProcess, job: Job) -> list[ShardRow]:
    database, _ = service.stores()
    with database.reading() as session:
        found = session.query(ShardRow).where(ShardRow.job_id == job.id, ShardRow.kind == SIMULATION).all()
    database.dispose()
    return found


def test_a_trace_runs_to_its_end_through_a_killed_worker(
    service: ServiceProcess, client: Client, scene_id: str
) -> None:
    job = client.traces.create(scene_id, SMALL, fit=FIT)
    until(lambda: bool(simulations(service, job)), "no simulation is shared", ENDS_WITHIN_S)
    database, _ = service.stores()
    with database.reading() as session:
        driver = session.query(ShardRow).where(ShardRow.job_id == job.id, ShardRow.kind == "trace").one()
    database.dispose()
    assert driver.lease_owner is not None
    pid = int(driver.lease_owner.split("/")[2])
    worker = psutil.Process(pid).ppid()
    os.kill(worker, signal.SIGKILL)  # its pool process dies with it
    job = client.jobs.wait(job, timeout=ENDS_WITHIN_S)
    assert job.attempt >= 2, "another worker took the trace over"
    trace = client.traces.get(job.outputs[0].id)
    assert (trace.state, trace.scene) == ("ready", "tiny bar")
    assert trace.held_out is not None and trace.held_out["before"] > 0
    tracks = client.traces.tracks(trace.id)
    assert tracks["before"].shape == (45, 4, 3) and np.isfinite(tracks["after"]).all()
    assert {row.state for row in simulations(service, job)} <= {"DONE", "CANCELLED"}
    stores = service.stores()[1]
    assert stores.scratch.jobs() == []
    page = next(item for item in trace.artifacts if item.name == "report.html")
    state = service.state()
    token = Path(state["api_key_file"]).read_text().strip()
    answer = httpx.get(
        f"{state['api_url']}/v1/artifacts/{page.sha256}",
        headers={"Authorization": f"Bearer {token}"},
        trust_env=False,
    )
    assert answer.content.lower().startswith(b"<!doctype html>")


def test_a_cancelled_trace_ends_with_its_simulations(
    service: ServiceProcess, client: Client, scene_id: str
) -> None:
    config = SMALL.model_copy(update={"seed": 1, "iterations": 40, "confirmed": 2})
    job = client.traces.create(scene_id, config, fit=FIT)
    until(lambda: bool(simulations(service, job)), "no simulation is shared", ENDS_WITHIN_S)
    client.traces.cancel(job.outputs[0].id)

    def ended() -> bool:
        return client.jobs.get(job.id).state in TERMINAL_STATES

    until(ended, "the trace does not stop", ENDS_WITHIN_S)
    assert client.jobs.get(job.id).state == "cancelled"
    assert client.traces.get(job.outputs[0].id).state == "cancelled"
    assert {row.state for row in simulations(service, job)} <= {"DONE", "CANCELLED"}
