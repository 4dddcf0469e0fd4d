"""A cancelled job whose worker is in native code is cancelled within seconds, and the process is gone."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from service_process import environment, until
from sqlalchemy import select
from tiny_scene import register, tiny_scene

from physworld_schemas.fit import FitConfig
from physworld_storage.database import open_database
from physworld_storage.jobs import jobs
from physworld_storage.settings import Settings
from physworld_storage.tables import ShardRow
from physworld_workers.stores import Stores

PROCESS = Path(__file__).with_name("deaf_process.py")
ANSWER_S = 5.0
START_S = 60.0


@pytest.mark.slow
def test_work_that_hears_nothing_is_cancelled_within_seconds(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "data")
    database = open_database(settings)
    database.upgrade()
    scene_id = register(tiny_scene(), database, Stores(settings, database).artifacts)
    with database.session() as session:
        job = jobs.create_fit(session, scene_id, FitConfig())
        (shard_id,) = session.scalars(select(ShardRow.id).where(ShardRow.job_id == job.id))

    def state() -> str:
        with database.reading() as session:
            return jobs.get_job(session, job.id).state

    words = [sys.executable, str(PROCESS), str(settings.data_dir), shard_id]
    inherited = {**environment(), "PYTHONPATH": str(PROCESS.parents[2])}
    with subprocess.Popen(words, env=inherited) as worker:
        try:
            until(lambda: state() == "running", "nobody took the shard", START_S)
            with database.session() as session:
                assert jobs.cancel_job(session, job.id).state == "cancelling"
            asked = time.monotonic()
            until(lambda: state() == "cancelled", "the job is not cancelled", START_S)
            assert time.monotonic() - asked < ANSWER_S
            assert worker.wait(ANSWER_S) == -signal.SIGKILL
        finally:
            worker.kill()
    database.dispose()
