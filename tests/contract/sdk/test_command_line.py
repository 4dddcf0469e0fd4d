"""The command ``physworld`` as its own process, against the real API."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sdk_service import METRICS, ROWS, Service, write_scene

from physworld_schemas.base import Problem
from physworld_storage.jobs import leases

COMMAND = Path(sys.executable).with_name("physworld")
WITHIN_S = 120.0


def environment(service: Service | None, home: Path) -> dict[str, str]:
    """The process's environment: an empty home, and the service's address when there is one."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("PHYSWORLD_")}
    given = {} if service is None else {"PHYSWORLD_URL": service.url, "PHYSWORLD_TOKEN": service.token}
    return {**inherited, "HOME": str(home), **given}


def physworld(
    service: Service | None, home: Path, *arguments: str | Path
) -> subprocess.CompletedProcess[str]:
    """Runs the command to its end."""
    return subprocess.run(
        [COMMAND, *map(str, arguments)],
        env=environment(service, home),
        cwd=home,
        capture_output=True,
        text=True,
        timeout=WITHIN_S,
        check=False,
    )


def output_of(service: Service, home: Path, *arguments: str | Path) -> Any:
    """The JSON that a command prints."""
    done = physworld(service, home, *arguments, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@contextmanager
def worker(service: Service) -> Iterator[None]:
    """A worker beside the command."""
    ended = threading.Event()

    def work() -> None:
        while not ended.wait(0.05):
            service.work()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_run_prints_the_table_and_writes_the_report(service: Service, tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "strip", "strip")
    with worker(service):
        arguments = (
            "run",
            scene,
            "--episodes",
            "3",
            "--hidden",
            "16",
            "--seed",
            "5",
            "--json",
            "report.json",
        )
        done = physworld(service, tmp_path, *arguments)
    assert done.returncode == 0, done.stderr
    for text in ("rigid-follow", "world model, fine-tuned", "noise floor of the track error: 0.50 mm"):
        assert text in done.stdout
    assert "steps per second: twin 12, world model 345.6" in done.stdout
    assert f"dashboard: {service.url}/dashboard" in done.stdout
    report = json.loads((tmp_path / "report.json").read_text())
    for metric in METRICS:
        assert set(report["held_out"][metric]) == set(ROWS)
    assert report["steps_per_second"] == {"twin": 12.0, "world_model": 345.6}
    assert (report["model"]["name"], report["model"]["version"]) == ("strip", 1)
    assert set(report["seconds"]) == {"fit", "dataset", "training", "total"}
    assert (report["episodes"], report["noise_floor_m"]) == (3, 0.0005)
    manifest = tmp_path / "strip-1" / "manifest.json"
    assert f"model: strip version 1, sha256 {report['model']['sha256']}" in done.stdout
    assert json.loads(manifest.read_text())["version"] == 1
    with service.client() as client:
        config = client.jobs.list(kind="pipeline", limit=1).data[0].config
    assert (config["training"]["hidden"], config["dataset"]["episodes"]) == (16, 3)
    assert [config[stage]["seed"] for stage in ("dataset", "training")] == [5, 5]


def test_a_failed_run_prints_the_problem_with_its_numbers(service: Service, tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "fails", "fails")
    detail = "dt 1.0e-4 s exceeds the CFL limit 6.1e-5 s for E 2.0e6 Pa"
    failing = threading.Timer(2.0, lambda: wait_and_fail(service, detail))
    failing.start()
    done = physworld(service, tmp_path, "run", scene)
    failing.join()
    assert done.returncode == 1
    assert detail in done.stderr
    assert "Traceback" not in done.stderr


def wait_and_fail(service: Service, detail: str) -> None:
    """Fails the next shard that is queued."""
    deadline = time.monotonic() + WITHIN_S
    while time.monotonic() < deadline:
        lease = service.claim()
        if lease is not None:
            service.fail_lease(
                lease, Problem(title="Unstable", status=422, code="cfl_violation", detail=detail)
            )
            return
        time.sleep(0.05)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "sigterm"])
def test_an_interrupted_run_cancels_its_job(service: Service, tmp_path: Path, number: signal.Signals) -> None:
    scene = write_scene(tmp_path / "stopped", "stopped")
    with subprocess.Popen(
        [COMMAND, "run", str(scene)],
        env={**environment(service, tmp_path), "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        assert running.stdout is not None and running.stderr is not None
        for line in running.stdout:
            if line.startswith("fit"):
                break
        running.send_signal(number)
        errors = running.stderr.read()
        assert running.wait(WITHIN_S) == 130
    assert "is cancelled" in errors
    with service.client() as client:
        assert client.jobs.list(kind="pipeline", limit=1).data[0].state == "cancelled"


def test_lists_show_and_download(service: Service, tmp_path: Path) -> None:
    added = output_of(service, tmp_path, "scenes", "add", write_scene(tmp_path / "listed", "listed"))
    assert added["id"] in {scene["id"] for scene in output_of(service, tmp_path, "scenes", "list")}
    with service.client() as client:
        client.pipelines.create(scene_id=added["id"])
    service.work()
    [job] = output_of(service, tmp_path, "jobs", "list", "--kind", "pipeline", "-n", "1")
    assert output_of(service, tmp_path, "jobs", "show", job["id"])["state"] == "succeeded"
    [fit] = output_of(service, tmp_path, "fits", "list", "-n", "1")
    [dataset] = output_of(service, tmp_path, "datasets", "list", "-n", "1")
    assert (fit["scene_id"], dataset["fit_id"]) == (added["id"], fit["id"])
    episodes = output_of(service, tmp_path, "datasets", "episodes", dataset["id"], "-n", "1000")
    assert len(episodes) == dataset["episodes_done"]
    assert "listed" in {model["name"] for model in output_of(service, tmp_path, "models", "list")}
    assert output_of(service, tmp_path, "models", "show", "listed")["version"] == 1

    for arguments, place in (
        (("models", "download", "listed"), "listed-1/model.safetensors"),
        (("fits", "download", fit["id"], "-o", "files"), "files/twin.npz"),
        (("datasets", "download", dataset["id"], "--episodes", "-o", "all"), "all/episode-00000.npz"),
        (
            ("datasets", "export", dataset["id"], "-f", "lerobot", "--episodes", "2", "-o", "robot"),
            "robot/meta/info.json",
        ),
        (
            ("datasets", "export", dataset["id"], "-f", "ply", "--episodes", "2"),
            f"{dataset['id']}-ply/episode-00000/frame-00000.ply",
        ),
        (("models", "alias", "listed", "champion", "1"), ""),
        (("models", "download", "listed", "--version", "champion", "-o", "again"), "again/card.json"),
    ):
        done = physworld(service, tmp_path, *arguments)
        assert done.returncode == 0, done.stderr
        assert (tmp_path / place).exists()

    for kind in ("scenes", "fits", "datasets", "models", "jobs"):
        done = physworld(service, tmp_path, kind, "list")
        assert done.returncode == 0, done.stderr
        assert len(done.stdout.splitlines()) >= 2


def test_jobs_are_cancelled_and_waited_for(service: Service, tmp_path: Path) -> None:
    with service.client() as client:
        scene = client.scenes.create(write_scene(tmp_path / "waits", "waits"))
        job, other = client.fits.create(scene.id), client.fits.create(scene.id)
    assert output_of(service, tmp_path, "jobs", "cancel", other.id)["state"] == "cancelled"
    service.work()
    assert physworld(service, tmp_path, "jobs", "wait", job.id).returncode == 0
    done = physworld(service, tmp_path, "jobs", "wait", other.id)
    assert (done.returncode, done.stderr) == (1, f"error: fit job {other.id} was cancelled\n")


def test_a_failed_job_is_retried(service: Service, tmp_path: Path) -> None:
    with service.client() as client:
        job = client.fits.create(client.scenes.create(write_scene(tmp_path / "again", "again")).id)
    refused = physworld(service, tmp_path, "jobs", "retry", job.id)
    assert refused.returncode != 0 and "only a failed job can be retried" in refused.stderr
    lease = service.claim()
    assert lease is not None and lease.job_id == job.id
    with service.database.session() as session:
        leases.fail(session, lease, Problem(title="Boom", status=500, code="boom"), retry=False)
    assert output_of(service, tmp_path, "jobs", "retry", job.id)["state"] == "queued"
    service.work()
    assert physworld(service, tmp_path, "jobs", "wait", job.id).returncode == 0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("jobs", "list"), "error: no service runs on {home}/.local/share/physworld"),
        (("jobs", "list", "--url", "http://127.0.0.1:9"), "error: no connection to http://127.0.0.1:9"),
        (("jobs", "list", "--url", "nonsense"), "error: 'nonsense' is not an http address"),
        (("run", "nowhere", "--url", "http://127.0.0.1:9"), "error: no scene at nowhere"),
    ],
)
def test_an_error_is_one_clear_line(tmp_path: Path, arguments: tuple[str, ...], text: str) -> None:
    done = physworld(None, tmp_path, *arguments)
    assert done.returncode == 1
    assert done.stderr.startswith(text.format(home=tmp_path))
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("command", "held", "code", "text"),
    [
        (
            ("rollout", "No Name"),
            {"controllers": np.zeros((9, 4, 3))},
            2,
            "error: model: String should match",
        ),
        (
            ("plan", "bar", "--horizon", "999"),
            {"shape": np.zeros((2, 3))},
            2,
            "error: horizon: Input should be",
        ),
        (
            ("plan", "bar"),
            {"index": np.arange(3), "places": np.zeros((2, 3))},
            1,
            "has index (3,) of int64 and places (2, 3)",
        ),
        (
            ("plan", "bar"),
            {"index": np.array([4, 4]), "places": np.zeros((2, 3))},
            1,
            "names 1 of 2 points twice",
        ),
    ],
)
def test_a_request_that_cannot_be_made_is_one_clear_line(
    tmp_path: Path, command: tuple[str, ...], held: dict[str, np.ndarray], code: int, text: str
) -> None:
    file = tmp_path / "given.npz"
    np.savez(file, allow_pickle=False, **held)
    given = "--controllers" if command[0] == "rollout" else "--goal"
    options = (given, str(file), "--out", str(tmp_path / "out.npz"), "--url", "http://127.0.0.1:9")
    done = physworld(None, tmp_path, *command, *options)
    assert (done.returncode, len(done.stderr.splitlines())) == (code, 1), done.stderr
    assert done.stderr.startswith("error: ") and text in done.stderr


def test_a_report_that_is_none_is_named(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    options = (
        "--controllers",
        str(report),
        "--out",
        str(tmp_path / "out.npz"),
        "--url",
        "http://127.0.0.1:9",
    )
    for text in ("{", "[]", '{"controllers": [[[0, 0, 0]]]}'):
        report.write_text(text)
        done = physworld(None, tmp_path, "rollout", "bar", *options)
        assert (done.returncode, len(done.stderr.splitlines())) == (1, 1), done.stderr
        assert f"{report} is no report of a trace" in done.stderr


def test_the_version_is_that_of_the_distribution(tmp_path: Path) -> None:
    done = physworld(None, tmp_path, "version")
    assert (done.returncode, done.stdout) == (0, "0.2.0\n")
