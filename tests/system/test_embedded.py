"""The embedded service as a person uses it: start, look, start again, Ctrl-C, kill, start again."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import stat
import subprocess
import sys
import urllib.request
from pathlib import Path

import psutil
import pytest
import redis
from service_process import END_WITHIN_S, ServiceProcess, environment, until, wait_for_job
from tiny_scene import register, tiny_scene

from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_services.embedded.broker import choose_broker
from physworld_services.embedded.folder import DataFolder
from physworld_storage.access import api_keys
from physworld_storage.jobs import jobs
from physworld_storage.tables import ApiKeyRow, ShardRow

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

RESTART_WITHIN_S = 60.0
ANSWER_WITHIN_S = 60.0
JOB_WITHIN_S = 120.0
DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def _status(url: str, token: str | None = None) -> int:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    with DIRECT.open(urllib.request.Request(url, headers=headers), timeout=ANSWER_WITHIN_S) as answer:
        return int(answer.status)


def test_start_look_start_again_and_ctrl_c(tmp_path: Path) -> None:
    with ServiceProcess(tmp_path / "data", "--workers", "2") as service:
        service.start()
        state = service.state()
        assert set(state["children"]) == {
            "broker",
            "web",
            "dispatcher",
            "worker-1",
            "worker-2",
            "trainer",
            "inference",
            "planner",
        }
        key_file = Path(state["api_key_file"])
        assert stat.S_IMODE(key_file.stat().st_mode) == 0o600
        assert _status(f"{state['api_url']}/health/ready") == 200
        assert _status(f"{state['api_url']}/v1/jobs", key_file.read_text().strip()) == 200

        second = subprocess.run(
            [sys.executable, "-m", "physworld_services.embedded", "--data", str(service.data)],
            env=environment(),
            capture_output=True,
            text=True,
            check=False,
        )
        assert second.returncode == 3
        assert "already running" in second.stdout and state["api_url"] in second.stdout
        assert service.state() == state

        family = service.family()
        assert len(family) >= 10  # the supervisor, six children, three pool processes
        assert service.interrupt() == 0
        _, alive = psutil.wait_procs(family, END_WITHIN_S)
        assert alive == []
        assert service.state() == {}

        service.start()
        assert service.state()["api_url"] == state["api_url"]  # after a clean stop too
        assert service.interrupt() == 0


def test_a_service_whose_own_key_was_ended_says_so_and_makes_another(tmp_path: Path) -> None:
    with ServiceProcess(tmp_path / "data", "--workers", "0", "--no-trainer", "--no-inference") as service:
        service.start()
        key_file = service.data / "api-key"
        first = key_file.read_text().strip()
        assert service.interrupt() == 0
        database, _ = service.stores()
        with database.session() as session:
            own = api_keys.verify(session, first)
            assert own is not None
            api_keys.create_key(session, "person", "admin")
            api_keys.revoke_key(session, own.id)
        service.start()
        second = key_file.read_text().strip()
        assert second != first and stat.S_IMODE(key_file.stat().st_mode) == 0o600
        said = service.output.read_text()
        assert f"{key_file} holds an ended key: the token is known as key {own.id}, revoked at" in said
        assert second not in said
        assert _status(f"{service.state()['api_url']}/v1/audit", second) == 200
        modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in service.data.glob("physworld.db*")}
        assert set(modes.values()) == {0o600}, modes
        assert service.interrupt() == 0
        key_file.unlink()
        with database.session() as session:
            for key in api_keys.list_keys(session).data:
                session.get_one(ApiKeyRow, key.id).revoked_at = key.created_at  # nobody is left
        service.start()
        assert _status(f"{service.state()['api_url']}/v1/keys", key_file.read_text().strip()) == 200
        assert service.interrupt() == 0
        database.dispose()


def test_a_killed_child_is_started_again_and_the_url_stays(tmp_path: Path) -> None:
    with ServiceProcess(tmp_path / "data", "--workers", "1", "--no-trainer") as service:
        service.start()
        url = service.state()["api_url"]
        for name in ("web", "broker", "worker-1", "dispatcher"):
            before = service.kill_child(name)
            until(
                lambda name=name, before=before: service.state()["children"].get(name, before) != before,
                f"{name} is not started again",
                RESTART_WITHIN_S,
            )
        assert _status(f"{url}/health/live") == 200
        service.kill()
        service.start()
        assert service.state()["api_url"] == url
        assert service.interrupt() == 0


def test_work_that_ctrl_c_stopped_carries_on_untried_and_can_be_cancelled(tmp_path: Path) -> None:
    with ServiceProcess(tmp_path / "data", "--workers", "1", "--no-trainer") as service:
        service.start()
        database, stores = service.stores()
        scene_id = register(tiny_scene(frames=90), database, stores.artifacts)
        with database.session() as session:
            job = jobs.create_fit(session, scene_id, FitConfig(particle_budget=2000, max_simulations=500))

        def shard() -> tuple[str, int]:
            with database.reading() as session:
                row = session.query(ShardRow).where(ShardRow.kind == "fit").one()
            return row.state, row.attempt

        def job_now() -> Job:
            with database.reading() as session:
                return jobs.get_job(session, job.id)

        until(lambda: job_now().progress.done >= 1, "the fit does not start", RESTART_WITHIN_S)
        assert service.interrupt() == 0
        assert shard() == ("QUEUED", 0)
        assert job_now().state == "running"
        service.start()
        until(lambda: shard() == ("RUNNING", 1), "the fit does not go on", RESTART_WITHIN_S)
        with database.session() as session:
            assert jobs.cancel_job(session, job.id).state == "cancelling"
        until(lambda: job_now().state == "cancelled", "the fit does not stop", RESTART_WITHIN_S)
        assert service.interrupt() == 0
        database.dispose()


def test_two_services_share_a_broker_without_taking_each_others_work(tmp_path: Path) -> None:
    folder = DataFolder(tmp_path / "broker")
    folder.prepare()
    broker = choose_broker(folder, {})
    with contextlib.ExitStack() as stack:
        server = subprocess.Popen(broker.command, stdout=subprocess.DEVNULL)
        stack.callback(server.wait)
        stack.callback(server.terminate)
        until(broker.answers, "no broker", RESTART_WITHIN_S)
        started = []
        for name in ("first", "second"):
            variables = {"PHYSWORLD_BROKER_URL": broker.url}
            service = ServiceProcess(tmp_path / name, "--workers", "1", "--no-trainer", variables=variables)
            stack.enter_context(service)
            service.start()
            assert "broker" not in service.state()["children"]
            database, stores = service.stores()
            stack.callback(database.dispose)
            scene_id = register(tiny_scene(), database, stores.artifacts)
            with database.session() as session:
                jobs_made = [
                    jobs.create_fit(session, scene_id, FitConfig(particle_budget=60, max_simulations=1))
                    for _ in range(4)
                ]
            started.append((database, jobs_made))
        for database, jobs_made in started:
            for job in jobs_made:
                wait_for_job(database, job.id, JOB_WITHIN_S)
        with redis.Redis.from_url(broker.url) as client:
            assert all(key.startswith(b"physworld-") for key in client.scan_iter())


def test_a_port_that_somebody_has_is_named(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "physworld_services.embedded",
                "--data",
                str(tmp_path / "data"),
                "--port",
                str(port),
            ],
            env=environment(),
            capture_output=True,
            text=True,
            check=False,
        )
    assert done.returncode == 1
    assert f"port {port} on 127.0.0.1 cannot be had" in done.stderr


def test_settings_that_cannot_work_end_the_start_with_their_names(tmp_path: Path) -> None:
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "physworld_services.embedded",
            "--data",
            str(tmp_path / "data"),
            "--no-trainer",
        ],
        env={**environment(), "PHYSWORLD_BROKER_URL": "http://not-a-broker"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "PHYSWORLD_BROKER_URL has scheme 'http'" in done.stderr
    assert not (tmp_path / "data" / "run" / "state.json").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="PR_SET_PDEATHSIG is Linux's")
def test_nobody_survives_a_supervisor_killed_while_it_starts(tmp_path: Path) -> None:
    service = ServiceProcess(tmp_path / "data", "--workers", "1", "--no-trainer")
    with service.output.open("wb") as output:
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "physworld_services.embedded",
                "--data",
                str(service.data),
                *service.options,
            ],
            env=environment(),
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    with process:
        supervisor = psutil.Process(process.pid)
        until(lambda: len(supervisor.children()) >= 2, "no children yet", RESTART_WITHIN_S)
        family = supervisor.children(recursive=True)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        _, alive = psutil.wait_procs(family, END_WITHIN_S)
        assert alive == []
