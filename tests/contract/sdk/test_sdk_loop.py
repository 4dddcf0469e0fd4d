"""Traces, assessments and the closed loop through the SDK and the command line, against the real API."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest
from physworld_client import AsyncClient, Client
from physworld_client.errors import Conflict, NotFound
from sdk_service import Service, write_scene
from test_command_line import output_of, physworld, worker

from physworld_schemas.check import CheckConfig
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceConfig


def test_a_check_step_by_step(service: Service, client: Client, tmp_path: Path) -> None:
    scene = client.scenes.create(write_scene(tmp_path / "checked", "checked"))
    job = client.checks.create(scene.id, CheckConfig(motions=0, noise_m=1e-4))
    check_id = job.outputs[0].id
    assert client.checks.get(check_id).report is None
    service.work()
    client.jobs.wait(job, timeout=30)
    check = client.checks.get(check_id)
    assert check.report is not None and check.config.noise_m == 1e-4
    usual = check.report.views[-1]
    assert usual.effects[0].gates[0].detectable == 4.25 and usual.effects[1].multiple is None
    assert [item.id for item in client.checks.list(scene_id=scene.id).data] == [check_id]
    done = physworld(service, tmp_path, "checks", "list", "--scene", scene.id)
    assert done.returncode == 0 and check_id in done.stdout, done.stderr
    assert output_of(service, tmp_path, "checks", "show", check_id)["report"]["noise_m"] == 1e-4

    async def asked() -> None:
        async with AsyncClient(service.url, service.token) as other:
            assert (await other.checks.get(check_id)).id == check_id

    asyncio.run(asked())


def test_a_trace_step_by_step(service: Service, client: Client, tmp_path: Path) -> None:
    scene = client.scenes.create(write_scene(tmp_path / "traced", "traced"))
    fitting = client.fits.create(scene.id)
    service.work()
    fit_id = fitting.outputs[0].id
    config = TraceConfig(candidates=["air_drag_linear"], seed=3)
    job = client.traces.create(scene.id, config, fit=FitConfig(particle_budget=300), fit_id=fit_id)
    trace_id = job.outputs[0].id
    with pytest.raises(Conflict):
        client.traces.tracks(trace_id)
    service.work()
    client.jobs.wait(job, timeout=30)
    trace = client.traces.get(trace_id)
    assert (trace.verdict, trace.fit_id, trace.config.seed) == ("named", fit_id, 3)
    assert trace.fit.particle_budget == 300
    assert trace.effects[0].parameters["rate_per_s"].ci95 == (1.6, 2.2)
    assert client.traces.tracks(trace_id)["before"].shape == (3, 2, 3)
    assert [item.id for item in client.traces.list(scene_id=scene.id, verdict="named").data] == [trace_id]
    writing = client.datasets.create(fit_id, DatasetConfig(episodes=1), trace_id=trace_id)
    assert client.datasets.get(writing.outputs[0].id).trace_id == trace_id
    client.jobs.cancel(writing.id)
    with pytest.raises(Conflict):
        client.traces.cancel(trace_id)

    async def same() -> None:
        async with AsyncClient(service.url, service.token) as other:
            assert await other.traces.get(trace_id) == trace
            with pytest.raises(NotFound):
                await other.assessments.get("ass_none")

    asyncio.run(same())


def test_the_loop_on_the_command_line(service: Service, tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "looped", "looped")
    small = ("--episodes", "1", "--json", "report.json")
    with worker(service):
        done = physworld(service, tmp_path, "run", scene, "--close-the-loop", *small)
    assert done.returncode == 0, done.stderr
    for stage in ("trace", "dataset_2", "training_2"):
        assert any(line.startswith(f"{stage} ") for line in done.stdout.splitlines()), done.stdout
    report = json.loads((tmp_path / "report.json").read_text())
    assert set(report["seconds"]) == {
        "fit", "trace", "dataset", "training", "dataset_2", "training_2", "total",
    }  # fmt: skip
    assert report["model"]["version"] == 2
    with service.client() as client:
        assert client.models.version("looped").trace_id is not None

    with worker(service):
        done = physworld(service, tmp_path, "models", "assess", "looped", scene, "--version", "1")
    assert done.returncode == 0, done.stderr
    assert "worse_than_expected: The model errs more" in done.stdout
    opened = done.stdout.rpartition("trace opened: ")[2].strip()
    [assessed] = output_of(service, tmp_path, "assessments", "list")
    assert output_of(service, tmp_path, "assessments", "list", "--model", "looped") == [assessed]
    with service.client() as client:
        every = [client.assessments.list(*of).data for of in ((), ("looped",), ("looped", 1))]
        assert [[item.id for item in page] for page in every] == 3 * [[assessed["id"]]]
        assert client.assessments.list("looped", 2).data == client.assessments.list("nobody").data == []
        with pytest.raises(ValueError, match="version 1 of which model"):
            client.assessments.list(version=1)
    [newest] = output_of(service, tmp_path, "traces", "list", "-n", "1")
    assert newest["id"] == opened
    service.work()
    shown = physworld(service, tmp_path, "traces", "show", opened).stdout
    assert "effect      air_drag_linear: rate_per_s 1.9 1/s (95 %: 1.6 to 2.2)" in shown
    assert "held-out error [mm]: 21 → 6 (noise 1)" in shown
    done = physworld(service, tmp_path, "traces", "download", opened, "-o", "files")
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (tmp_path / "files").iterdir()} == {"report.json", "tracks.npz", "twin.npz"}
    job = output_of(service, tmp_path, "traces", "add", newest["scene_id"])
    cancelled = output_of(service, tmp_path, "traces", "cancel", job["outputs"][0]["id"])
    assert (cancelled["id"], cancelled["state"]) == (job["id"], "cancelled")


def test_a_turn_of_the_loop_from_the_sdk_and_the_command_line(
    service: Service, client: Client, tmp_path: Path
) -> None:
    home = client.scenes.create(write_scene(tmp_path / "turned", "turned"))
    client.pipelines.create(
        PipelineCreate(scene_id=home.id, model_name="turned", dataset=DatasetConfig(episodes=1))
    )
    service.work()
    new = client.scenes.create(write_scene(tmp_path / "new", "turned again"))
    with pytest.raises(Conflict, match="needs another one"):
        client.loops.create("turned", home.id)
    job = client.loops.create("turned", new.id, 1, trace=TraceConfig(seed=4))
    running = client.loops.get(job.id)
    assert (running.state, running.outcome, running.version) == ("queued", None, 1)
    service.work()
    client.jobs.wait(job, timeout=30)
    loop = client.loops.get(job.id)
    assert (loop.outcome, loop.verdict, loop.new_version) == ("improved", "named", 2)
    assert loop.before is not None and loop.before.measured.error_m == 0.03
    assert [item.id for item in client.loops.list(model="turned").data] == [job.id]
    assert client.loops.list(model="turned", state="failed").data == []
    assert client.traces.get(str(loop.trace_id)).config.seed == 4

    shown = physworld(service, tmp_path, "loops", "show", job.id[-8:].lower())
    assert shown.returncode != 0, "the end of an id names nothing"
    shown = physworld(service, tmp_path, "loops", "show", job.id)
    assert "improved: On held-out frames of the new recording version 2 errs 9 mm" in shown.stdout, (
        shown.stderr
    )
    assert "version 1   30 mm (95 %: 20 to 40), its twin 20" in shown.stdout
    assert "effect      air_drag_linear" in shown.stdout and "also [mm]: static 50" in shown.stdout
    [listed] = output_of(service, tmp_path, "loops", "list", "--model", "turned")
    assert listed["id"] == job.id

    started = output_of(service, tmp_path, "loops", "add", "--assessment", str(loop.assessment_id))
    assert output_of(service, tmp_path, "loops", "cancel", started["id"])["state"] == "cancelled"
    nothing = physworld(service, tmp_path, "loops", "add", "turned")
    assert nothing.returncode == 2 and "a MODEL and a SCENE are needed" in nothing.stderr
    with worker(service):
        held = physworld(
            service, tmp_path, "models", "assess", "turned", new.id, "--held-out", "--beside", "1"
        )
    assert "version 1 30 mm (95 %: 20 to 40), gain 21 (95 %: 10 to 30)" in held.stdout, held.stderr

    async def same() -> None:
        async with AsyncClient(service.url, service.token) as other:
            assert await other.loops.get(job.id) == loop
            with pytest.raises(NotFound):
                await other.loops.get("job_none")

    asyncio.run(same())
