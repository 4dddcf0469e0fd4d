"""An installation on a folder of its own: database, stores, a registered scene, a broker when asked for."""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from tiny_scene import register, tiny_scene

from physworld_schemas.fit import Fit, FitConfig
from physworld_services.embedded.broker import choose_broker
from physworld_services.embedded.child import Child, Program
from physworld_services.embedded.folder import DataFolder
from physworld_storage import resources
from physworld_storage.database import open_database
from physworld_storage.jobs import jobs, leases
from physworld_storage.settings import Settings
from physworld_workers.context import Handler
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores

BROKER_WITHIN_S = 20.0
DATABASE = "physworld.db"
RuntimeOf = Callable[..., Runtime]


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    """A worker's container is read-only: whatever a task writes below its data folder fails."""
    (tmp_path / "file").write_text("")
    return Settings(
        data_dir=tmp_path / "file" / "data",
        database_url=f"sqlite:///{tmp_path / DATABASE}",
        store_url=(tmp_path / "store").as_uri(),
        lease_seconds=5.0,
    )


@pytest.fixture
def stores(settings: Settings) -> Iterator[Stores]:
    database = open_database(settings)
    database.upgrade()
    yield Stores(settings, database)
    database.dispose()


@pytest.fixture
def scene_id(stores: Stores) -> str:
    return register(tiny_scene(), stores.database, stores.artifacts)


@pytest.fixture
def runtime_with(settings: Settings, stores: Stores) -> RuntimeOf:
    """A runtime whose handlers are the given functions; without any, those of the registry."""

    def make(**handlers: Handler) -> Runtime:
        runtime = Runtime(settings, stores.database, stores, process_owner())
        if not handlers:
            return runtime
        return Runtime(settings, stores.database, stores, process_owner(), handlers.__getitem__)

    return make


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Fit]:
    """A folder with a database and a store, and the fit that the real handler made in it."""
    folder = tmp_path_factory.mktemp("fitted")
    settings = Settings(
        data_dir=folder / "data",
        database_url=f"sqlite:///{folder / DATABASE}",
        store_url=(folder / "store").as_uri(),
    )
    database = open_database(settings)
    database.upgrade()
    stores = Stores(settings, database)
    scene_id = register(tiny_scene(), database, stores.artifacts)
    with database.session() as session:
        job = jobs.create_fit(session, scene_id, FitConfig(particle_budget=60, max_simulations=6))
    with database.reading() as session:
        (shard,) = leases.publishable(session)
    assert run_shard(Runtime(settings, database, stores, process_owner()), shard.shard_id) == "done"
    with database.reading() as session:
        made = resources.get_fit(session, job.outputs[0].id)
    database.dispose()
    return folder, made


@pytest.fixture
def fit(fitted: tuple[Path, Fit], stores: Stores, tmp_path: Path) -> Fit:
    """The fit, in the test's own database and store."""
    folder, made = fitted
    shutil.copytree(folder / "store", tmp_path / "store", dirs_exist_ok=True)
    with (
        closing(sqlite3.connect(folder / DATABASE)) as one,
        closing(sqlite3.connect(tmp_path / DATABASE)) as own,
    ):
        one.backup(own)
    return made


@pytest.fixture
def broker_url(tmp_path: Path) -> Iterator[str]:
    """The address of a real broker of this test's own, on a free port."""
    folder = DataFolder(tmp_path / "broker-data")
    folder.prepare()
    broker = choose_broker(folder, {})
    family = os.open(folder.run / "family", os.O_CREAT | os.O_RDWR)
    child = Child(Program("broker", broker.command, dict(os.environ)), folder.logs / "broker.log", family)
    child.start()
    deadline = time.monotonic() + BROKER_WITHIN_S
    while not broker.answers():
        assert time.monotonic() < deadline, child.log.read_text()
        time.sleep(0.05)
    yield broker.url
    child.ask_to_stop()
    child.wait_or_kill(time.monotonic() + 5)
    os.close(family)
