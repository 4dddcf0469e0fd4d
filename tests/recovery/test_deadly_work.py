"""Work that kills the process which does it is found by real processes that die, and told from them in words."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from service_process import environment
from sqlalchemy import select
from tiny_scene import register, tiny_scene

from physworld_schemas.fit import FitConfig
from physworld_storage.database import open_database
from physworld_storage.jobs import jobs, leases, losses
from physworld_storage.settings import Settings
from physworld_storage.tables import ShardRow
from physworld_workers.owner import owner_is_gone
from physworld_workers.stores import Stores

PROCESS = Path(__file__).with_name("deadly_process.py")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_work_that_kills_its_workers_ends_its_job_and_no_other(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "data")
    database = open_database(settings)
    database.upgrade()
    scene_id = register(tiny_scene(), database, Stores(settings, database).artifacts)
    with database.session() as session:
        deadly, other = (jobs.create_fit(session, scene_id, FitConfig()) for _ in range(2))

    for death in range(1, losses.ALIKE + 1):
        with database.session() as session:
            (shard,) = session.scalars(select(ShardRow).where(ShardRow.job_id == deadly.id))
            assert shard.state == "QUEUED"
            shard.not_before = None  # the pause is waited for elsewhere
        words = [sys.executable, str(PROCESS), str(settings.data_dir), shard.id]
        root = str(PROCESS.parents[2])
        died = subprocess.run(words, env={**environment(), "PYTHONPATH": root}, timeout=120, check=False)
        assert died.returncode == -signal.SIGSEGV
        with database.session() as session:
            assert leases.end_leases_of(session, owner_is_gone) == 1
            assert leases.reap(session) == [shard.id]
        with database.reading() as session:
            job = jobs.get_job(session, deadly.id)
        assert job.state == ("failed" if death == losses.ALIKE else "running")

    assert job.error is not None and job.error.code == "work_kills_its_workers"
    assert f"lost {losses.ALIKE} times in a row by {losses.ALIKE} workers" in job.error.detail
    with database.reading() as session:
        assert jobs.get_job(session, other.id).state == "queued"
    with database.session() as session:
        assert jobs.retry_job(session, deadly.id).state == "queued"
    database.dispose()
