"""A trainer killed twice in the middle of its training ends with the version that it would have made undisturbed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load
from tiny_scene import register, tiny_scene

from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.model import TrainingConfig, TrainingCreate
from physworld_services.trainer.training import CHECKPOINT
from physworld_storage import registry
from physworld_storage.database import open_database
from physworld_storage.jobs import jobs, leases
from physworld_storage.settings import Settings
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores

PROCESS = Path(__file__).with_name("trainer_process.py")
WITHIN_S = 120.0
CONFIG = TrainingConfig(
    hidden=16,
    message_passing_steps=2,
    history=2,
    look_ahead=4,
    vertices=20,
    steps=96,
    batch_size=2,
    patience=0,
    fine_tune_steps=5,
    formats=[],
)


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    """A folder with a sealed dataset of the tiny scene."""
    settings = Settings(data_dir=tmp_path / "data", lease_seconds=20.0)
    database = open_database(settings)
    database.upgrade()
    runtime = Runtime(settings, database, Stores(settings, database), process_owner())
    scene_id = register(tiny_scene(24), database, runtime.stores.artifacts)
    with database.session() as session:
        fit = jobs.create_fit(session, scene_id, FitConfig(particle_budget=60, max_simulations=4))
    drain(runtime)
    with database.session() as session:
        jobs.create_dataset(session, fit.outputs[0].id, DatasetConfig(episodes=4))
    drain(runtime)
    yield runtime
    database.dispose()


def drain(runtime: Runtime) -> None:
    while True:
        with runtime.database.reading() as session:
            waiting = leases.publishable(session)
        if not waiting:
            return
        for publication in waiting:
            assert run_shard(runtime, publication.shard_id) == "done"


def start(runtime: Runtime) -> subprocess.Popen[bytes]:
    """A trainer in a process group of its own."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PHYSWORLD_")}
    command = [sys.executable, str(PROCESS), str(runtime.settings.data_dir)]
    return subprocess.Popen(command, env=environment, start_new_session=True, cwd=PROCESS.parents[2])


def open_training(runtime: Runtime) -> Job:
    with runtime.database.session() as session:
        dataset_id = jobs.list_jobs(session, kind="dataset").data[0].outputs[0].id
        return jobs.create_training(session, TrainingCreate(name="bar", dataset_id=dataset_id, config=CONFIG))


def kill_after_next_checkpoint(process: subprocess.Popen[bytes], runtime: Runtime, job: Job) -> bytes:
    """SIGKILL once a checkpoint that was not there before is; the checkpoint."""
    before = runtime.stores.scratch.get(job.id, CHECKPOINT)
    deadline = time.monotonic() + WITHIN_S
    while (now := runtime.stores.scratch.get(job.id, CHECKPOINT)) == before or now is None:
        assert process.poll() is None, "the training ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    return now


@pytest.mark.slow
def test_a_trainer_killed_twice_publishes_what_an_undisturbed_one_does(runtime: Runtime) -> None:
    undisturbed = open_training(runtime)
    assert start(runtime).wait(WITHIN_S) == 0

    disturbed = open_training(runtime)
    checkpoints = [kill_after_next_checkpoint(start(runtime), runtime, disturbed) for _ in range(2)]
    assert checkpoints[0] != checkpoints[1], "the second trainer made no progress"
    assert start(runtime).wait(WITHIN_S) == 0

    files = []
    for job, attempts in ((undisturbed, 1), (disturbed, 3)):
        with runtime.database.reading() as session:
            done = jobs.get_job(session, job.id)
            version = registry.get_version(session, "bar", int(done.outputs[0].id.rpartition(":")[2]))
        assert (done.state, done.attempt) == ("succeeded", attempts)
        read = {item.name: runtime.stores.artifacts.read_bytes(item.sha256) for item in version.artifacts}
        files.append((load(read["model.safetensors"]), json.loads(read["card.json"])))
        assert not runtime.stores.scratch.has(job.id, CHECKPOINT)
    (first, first_card), (second, second_card) = files
    assert first.keys() == second.keys()
    for name, values in first.items():
        assert np.array_equal(values, second[name]), f"{name} is not the same to the last bit"
    for figures in ("validation", "fine_tuning", "held_out"):
        assert first_card["metrics"][figures] == second_card["metrics"][figures]
    assert first_card["metrics"]["validation"]["steps"] == CONFIG.steps
