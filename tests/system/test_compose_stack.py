"""``docker-compose.yml`` as containers: the chain, a killed worker, an emptied broker, scaling, down and up again.

Starts nothing unless ``PHYSWORLD_COMPOSE_TEST=1``; the images must be there: those that the file names, or their
stand-ins (``scripts/compose_stand_ins.sh``). The tests share one stack and build on each other, in their order.
"""

from __future__ import annotations

import base64
import json
import os
import secrets
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import yaml
from physworld_client import Client
from physworld_client.world_model import WorldModel
from service_process import until
from tiny_scene import tiny_scene

from physworld_scenes.bundle import canonical_archive
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.model import TrainingConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.plan import PlanConfig
from physworld_schemas.signing import SIGNATURE_NAME

pytestmark = [pytest.mark.slow, pytest.mark.timeout(2400)]

HEALTHY_WITHIN_S, JOB_WITHIN_S = 600.0, 900.0
FIT = FitConfig(particle_budget=60, max_simulations=2, damping="none", numerics=False)
TRAINING = TrainingConfig(
    hidden=16, message_passing_steps=2, history=2, vertices=20, steps=12, batch_size=2, look_ahead=2
)
EPISODES, FRAMES, NAME = 40, 400, "bar"  # so much work that both kills come in the middle of it


class Stack:
    """One compose project with secrets, a port and volumes of its own."""

    def __init__(self, repository: Path) -> None:
        self.file = repository / "docker-compose.yml"
        self.project = f"physworld-test-{os.getpid()}"
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.token = secrets.token_hex(24)
        given = {
            line.split("=")[0]: secrets.token_hex(24)
            for line in (repository / ".env.example").read_text().splitlines()
            if line and not line.startswith("#")
        }
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("PHYSWORLD_")},
            **given,
            "PHYSWORLD_ADMIN_TOKEN": self.token,
            "PHYSWORLD_SIGNING_KEY": base64.b64encode(secrets.token_bytes(32)).decode(),
            "PHYSWORLD_API_PORT": str(self.port),
        }

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def compose(self, *words: str) -> str:
        """The output of a compose command on this project; AssertionError with its errors when it fails."""
        command = ["docker-compose"] if shutil.which("docker-compose") else ["docker", "compose"]
        options = ["--file", str(self.file), "--project-name", self.project]
        done = subprocess.run(
            [*command, *options, *words], env=self.environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr[-4000:]
        return done.stdout

    def containers(self, *services: str) -> list[dict[str, Any]]:
        """What the daemon says of the project's containers, or of those of some services."""
        ids = self.compose("ps", "--quiet", *services).split()
        return json.loads(docker("inspect", *ids)) if ids else []

    def up(self, *options: str) -> None:
        """Start and wait until every service is healthy and the migration has ended well."""
        self.compose("up", "--detach", "--no-build", *options)

        def healthy() -> bool:
            states = {item["Name"]: item["State"] for item in self.containers()}
            ended = [state["ExitCode"] for state in states.values() if "Health" not in state]
            return ended == [0] and all(
                state["Health"]["Status"] == "healthy" for state in states.values() if "Health" in state
            )

        began = time.monotonic()
        until(healthy, "the stack is not healthy", HEALTHY_WITHIN_S)
        print(f"healthy {time.monotonic() - began:.0f} s after compose had started everything")

    def client(self, known_keys: Path) -> Client:
        return Client(self.url, self.token, timeout=120.0, known_keys=known_keys)


def docker(*words: str) -> str:
    """The output of a docker command."""
    return subprocess.run(["docker", *words], capture_output=True, text=True, check=True).stdout


def why_not(repository: Path) -> str | None:
    """Why the stack cannot be started here; None when it can."""
    if os.environ.get("PHYSWORLD_COMPOSE_TEST") != "1":
        return "PHYSWORLD_COMPOSE_TEST is not 1"
    if not shutil.which("docker"):
        return "no docker on this machine"
    if subprocess.run(["docker", "info"], capture_output=True, check=False).returncode != 0:
        return "no Docker daemon answers"
    services = yaml.safe_load((repository / "docker-compose.yml").read_text())["services"]
    for image in sorted({service["image"] for service in services.values()}):
        if subprocess.run(["docker", "image", "inspect", image], capture_output=True, check=False).returncode:
            return f"no image {image}: docker compose build, or scripts/compose_stand_ins.sh"
    return None


@pytest.fixture(scope="module")
def stack(repository: Path) -> Iterator[Stack]:
    reason = why_not(repository)
    if reason is not None:
        pytest.skip(reason)
    started = Stack(repository)
    try:
        started.up()
        yield started
    finally:
        started.compose("down", "--volumes", "--timeout", "20")


@pytest.fixture(scope="module")
def known_keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("keys") / "known.json"


@pytest.fixture(scope="module")
def client(stack: Stack, known_keys: Path) -> Iterator[Client]:
    with stack.client(known_keys) as client:
        yield client


@pytest.fixture(scope="module")
def published(client: Client, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A pipeline on the tiny scene that has run to its end: the ids of what it made."""
    archive = tmp_path_factory.mktemp("scene") / "tiny.zip"
    archive.write_bytes(canonical_archive(tiny_scene()))
    scene = client.scenes.create(archive)
    body = PipelineCreate(
        scene_id=scene.id,
        model_name=NAME,
        fit=FIT,
        dataset=DatasetConfig(episodes=4, frames=24),
        training=TRAINING,
    )
    job = client.jobs.wait(client.pipelines.create(body), timeout=JOB_WITHIN_S)
    return {output.kind: output.id for output in job.outputs}


def test_containers_can_write_to_their_volumes_and_nowhere_else(stack: Stack) -> None:
    for item in stack.containers():
        if not item["State"]["Running"]:
            continue
        host = item["HostConfig"]
        assert host["ReadonlyRootfs"] and host["CapDrop"] == ["ALL"], item["Name"]
        assert item["RestartCount"] == 0, item["Name"]
        written = subprocess.run(["docker", "exec", item["Id"], "touch", "/usr/x"], capture_output=True)
        assert written.returncode != 0, item["Name"]
    published_ports = {item["Name"] for item in stack.containers() if item["HostConfig"]["PortBindings"]}
    assert len(published_ports) == 1


def test_the_chain_runs_through_the_containers(
    stack: Stack, client: Client, published: dict[str, str], known_keys: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "model"
    version = client.models.download(NAME, folder)  # refuses a manifest that is not signed
    assert version.state == "ready"
    assert (folder / SIGNATURE_NAME).exists() and len(client.models.signing_keys()) == 1
    model = WorldModel.load(folder, sha256=version.sha256, known_keys=known_keys)
    path = np.repeat(model.start_controllers[-1:], 12, axis=0)
    path[: len(model.start_controllers)] = model.start_controllers
    here = model.track(model.rollout(path))
    at_once = client.rollouts.create(NAME, path)
    queued = client.rollouts.create(NAME, path, as_job=True, timeout=JOB_WITHIN_S)
    for answer in (at_once, queued):
        assert np.abs(answer.points[0] - here).max() < 1e-5
    goal = PlanConfig(horizon=12, samples=16, iterations=2)
    job = client.plans.create(NAME, points={3: [0.12, 0.02, 0.01]}, config=goal)
    plan = client.plans.get(client.jobs.wait(job, timeout=JOB_WITHIN_S).outputs[0].id)
    assert plan.executed_error_m < plan.motionless_error_m
    assert httpx.get(f"{stack.url}/dashboard/login", trust_env=False).status_code == 200


def test_a_killed_worker_and_an_emptied_broker_lose_nothing(
    stack: Stack, client: Client, published: dict[str, str]
) -> None:
    config = DatasetConfig(episodes=EPISODES, frames=FRAMES, replay_share=0.0)
    job = client.datasets.create(published["fit"], config)
    made = job.outputs[0].id

    def committed() -> dict[int, str]:
        page = client.datasets.episodes(made, limit=100)
        return {episode.index: episode.digest for episode in page.data}

    def at_least(count: int) -> Callable[[], bool]:
        return lambda: len(committed()) >= count

    until(at_least(3), "no episodes are committed", JOB_WITHIN_S)
    docker("kill", "--signal", "KILL", stack.containers("worker")[0]["Id"])
    until(at_least(8), "the other worker commits nothing", JOB_WITHIN_S)
    docker("rm", "--force", stack.containers("broker")[0]["Id"])
    docker("volume", "rm", f"{stack.project}_broker-data")
    before = committed()
    assert len(before) < EPISODES, "the dataset was complete before the broker was emptied"
    stack.up("--scale", "worker=3")
    assert len([item for item in stack.containers("worker") if item["State"]["Running"]]) == 3
    client.jobs.wait(job, timeout=JOB_WITHIN_S)
    after = committed()
    assert sorted(after) == list(range(EPISODES)) and len(set(after.values())) == EPISODES
    assert {index: after[index] for index in before} == before
    assert client.datasets.get(made).state == "sealed"
    for index in range(EPISODES):
        assert len(client.datasets.episode(made, index)["particles"]) == FRAMES


def test_down_and_up_again_keeps_the_data(
    stack: Stack, published: dict[str, str], known_keys: Path, tmp_path: Path
) -> None:
    with stack.client(known_keys) as before:
        version = before.models.version(NAME)
        fit = before.fits.get(published["fit"])
    stack.compose("down", "--timeout", "20")
    assert stack.containers() == []
    stack.up()
    with stack.client(known_keys) as after:
        assert after.fits.get(published["fit"]) == fit
        assert after.models.download(NAME, tmp_path / "model").sha256 == version.sha256
        job = after.fits.create(fit.scene_id, FIT.model_copy(update={"max_simulations": 3}))
        assert after.jobs.wait(job, timeout=JOB_WITHIN_S).state == "succeeded"
