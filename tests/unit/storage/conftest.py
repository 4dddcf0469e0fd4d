"""Databases and stores for the storage's tests: SQLite in a fresh folder, Postgres and S3 where they are.

With ``PHYSWORLD_TEST_POSTGRES_URL`` set every test that takes ``database`` also runs on that server, each
in a schema of its own that is dropped afterwards. S3 is moto's server over real HTTP.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import boto3
import pytest
from moto.server import ThreadedMotoServer
from sqlalchemy import create_engine, make_url, text

from physworld_schemas.base import Problem
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.scene import Scene
from physworld_storage import resources
from physworld_storage.database import Database, open_database
from physworld_storage.jobs import jobs, leases
from physworld_storage.jobs.leases import Lease
from physworld_storage.settings import Settings

POSTGRES_VARIABLE = "PHYSWORLD_TEST_POSTGRES_URL"
BACKENDS = ["sqlite", *(["postgres"] if os.environ.get(POSTGRES_VARIABLE) else [])]
ACCESS_KEY, SECRET_KEY = "test-access", "test-secret"
LEASE_SECONDS = 30.0


class Work:
    """A worker and a client in one: makes scenes and jobs, takes shards, hands back plausible results."""

    def __init__(self, database: Database) -> None:
        self.database = database
        self._scenes = 0

    def scene(self, name: str = "soft beam") -> Scene:
        self._scenes += 1
        with self.database.session() as session:
            return resources.create_scene(
                session,
                name=name,
                kind="beam",
                digest=f"{self._scenes:064x}",
                frames=10,
                points=3,
                controllers=1,
                fps=30.0,
                duration_s=0.3,
                noise_sigma_m=1e-3,
                train=(0, 7),
                test=(7, 10),
            )

    def fit(self) -> Job:
        scene = self.scene()
        with self.database.session() as session:
            return jobs.create_fit(session, scene.id, FitConfig())

    def dataset(self, episodes: int) -> Job:
        """A dataset job that is queued, in a fit that is ready."""
        fit = self.finish(self.fit())
        with self.database.session() as session:
            return jobs.create_dataset(session, fit.outputs[0].id, DatasetConfig(episodes=episodes))

    def pipeline(self, episodes: int = 3) -> Job:
        scene = self.scene()
        request = PipelineCreate(scene_id=scene.id, dataset=DatasetConfig(episodes=episodes))
        with self.database.session() as session:
            return jobs.create_pipeline(session, request)

    def job(self, job: Job | str) -> Job:
        with self.database.reading() as session:
            return jobs.get_job(session, job if isinstance(job, str) else job.id)

    def cancel(self, job: Job) -> Job:
        with self.database.session() as session:
            return jobs.cancel_job(session, job.id)

    def waiting(self) -> list[str]:
        """Ids of the queued shards."""
        with self.database.reading() as session:
            found = leases.publishable(session, limit=10_000, republish_seconds=1e-9, window=10_000)
        return [publication.shard_id for publication in found]

    def claim(self, shard_id: str | None = None, owner: str = "worker-1") -> Lease:
        """Take a shard, the first that waits unless it is named."""
        chosen = shard_id or self.waiting()[0]
        with self.database.session() as session:
            lease = leases.claim(session, chosen, owner, LEASE_SECONDS)
        assert lease is not None
        return lease

    def complete(self, lease: Lease, **changes: Any) -> bool:
        with self.database.session() as session:
            return leases.complete(session, lease, self.result(lease, **changes), None)

    def fail(self, lease: Lease, retry: bool, detail: str = "dt 1e-4 s exceeds 6e-5 s") -> str:
        problem = Problem(title="Unstable", status=500, code="cfl_violation", detail=detail)
        with self.database.session() as session:
            return leases.fail(session, lease, problem, retry)

    def finish(self, job: Job) -> Job:
        """Do everything that waits, until the job has ended."""
        while self.job(job).state in {"queued", "running"}:
            self.complete(self.claim())
        return self.job(job)

    @staticmethod
    def result(lease: Lease, **changes: Any) -> dict[str, Any]:
        artifact = {"name": "twin.npz", "sha256": "a" * 64, "size": 3}
        results: dict[str, dict[str, Any]] = {
            "fit": {
                "parameters": {"youngs_modulus": {"value": 2e4, "unit": "Pa", "ci95": [1e4, 3e4]}},
                "metrics": {"track_m": 0.004},
                "artifacts": [artifact],
                "seconds": 1.5,
            },
            "dataset_plan": {
                "episodes": lease.payload.get("config", {}).get("episodes"),
                "frames": 10,
                "particles": 5,
            },
            "episode": {
                "index": lease.index,
                "path": f"{lease.payload.get('dataset_id')}/{lease.index}-e{lease.epoch}",
                "digest": f"{lease.index:064x}",
                "seed": 2**62 + lease.index,
                "frames": 10,
                "particles": 5,
                "motion": "lift",
                "seconds": 0.1,
            },
            "dataset_seal": {"digest": "c" * 64, "statistics": {"mean_speed_m_s": 0.1}, "artifacts": []},
            "training": {"artifacts": [artifact], "sha256": "e" * 64, "metrics": {"held_out": {}}},
        }
        return {**results[lease.kind], "lineage": {"code_version": "test", "seeds": {"main": 1}}, **changes}


@pytest.fixture(scope="session")
def sqlite_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A migrated, empty SQLite database to copy."""
    path = tmp_path_factory.mktemp("template") / "empty.db"
    database = Database(f"sqlite:///{path}")
    database.upgrade()
    database.dispose()
    return path


@pytest.fixture(params=BACKENDS)
def database_url(request: pytest.FixtureRequest, tmp_path: Path, sqlite_template: Path) -> Iterator[str]:
    """The URL of a migrated, empty database."""
    if request.param == "sqlite":
        path = tmp_path / "physworld.db"
        shutil.copy(sqlite_template, path)
        yield f"sqlite:///{path}"
        return
    server = make_url(os.environ[POSTGRES_VARIABLE]).set(drivername="postgresql+psycopg")
    schema = f"physworld_test_{uuid4().hex[:12]}"
    engine = create_engine(server)
    with engine.begin() as connection:
        connection.execute(text(f"CREATE SCHEMA {schema}"))
    url = server.update_query_dict({"options": f"-csearch_path={schema}"})
    address = url.render_as_string(hide_password=False)
    own = Database(address)
    own.upgrade()
    own.dispose()
    yield address
    with engine.begin() as connection:
        connection.execute(text(f"DROP SCHEMA {schema} CASCADE"))
    engine.dispose()


@pytest.fixture
def database(database_url: str, tmp_path: Path) -> Iterator[Database]:
    """A migrated, empty database."""
    opened = open_database(Settings(data_dir=tmp_path, database_url=database_url))
    yield opened
    opened.dispose()


@pytest.fixture(scope="session")
def make_work() -> type[Work]:
    """For tests that open databases of their own."""
    return Work


@pytest.fixture
def work(database: Database) -> Work:
    """A worker and a client of the database."""
    return Work(database)


@pytest.fixture(scope="session")
def s3_endpoint() -> Iterator[str]:
    """An S3 server on a free port of this machine."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture(params=["file", "s3"])
def store_settings(request: pytest.FixtureRequest, tmp_path: Path) -> Settings:
    """Settings with an empty store: a local folder, then a bucket."""
    if request.param == "file":
        return Settings(data_dir=tmp_path)
    endpoint = request.getfixturevalue("s3_endpoint")
    bucket = f"bucket-{uuid4().hex[:12]}"
    client = boto3.client(
        "s3",
        endpoint_url=endpoint,
        aws_access_key_id=ACCESS_KEY,
        aws_secret_access_key=SECRET_KEY,
        region_name="us-east-1",
    )
    client.create_bucket(Bucket=bucket)
    client.close()
    return Settings(
        data_dir=tmp_path,
        store_url=f"s3://{bucket}/some/prefix",
        s3_endpoint=endpoint,
        s3_access_key_id=ACCESS_KEY,
        s3_secret_access_key=SECRET_KEY,
    )
