"""One running service for the tests of a file, and clients of each role."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from uuid import uuid4

import httpx
import pytest
import structlog
import uvicorn
from api_service import Service
from sqlalchemy import create_engine, make_url, text

from physworld_services.stores import Stores
from physworld_services.web import create_app
from physworld_storage.database import open_database
from physworld_storage.settings import Settings

POSTGRES_VARIABLE = "PHYSWORLD_TEST_POSTGRES_URL"
START_WITHIN_S = 60.0
MAX_UPLOAD_BYTES = 300_000


@pytest.fixture(scope="session", autouse=True)
def plain_logs() -> None:
    """No coloured tracebacks: formatting one takes seconds."""
    structlog.configure(processors=[structlog.processors.JSONRenderer(default=repr)])


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The web application on SQLite and a local folder."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("data"), max_upload_bytes=MAX_UPLOAD_BYTES)
    yield from serve(settings)


@pytest.fixture(scope="module")
def postgres_url() -> Iterator[str]:
    """A database of our own on the server, dropped afterwards."""
    server = os.environ.get(POSTGRES_VARIABLE)
    if not server:
        pytest.skip(f"{POSTGRES_VARIABLE} names no Postgres server")
    url = make_url(server).set(drivername="postgresql+psycopg")
    name = f"physworld_api_{uuid4().hex[:12]}"
    engine = create_engine(url, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    yield url.set(drivername="postgresql", database=name).render_as_string(hide_password=False)
    with engine.connect() as connection:
        connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
    engine.dispose()


@pytest.fixture
def client(service: Service) -> Iterator[httpx.Client]:
    """A client with an administrator's key."""
    with service.client() as client:
        yield client


def serve(settings: Settings) -> Iterator[Service]:
    """Migrate the database that the settings name and serve the application until the test is over."""
    database = open_database(settings)
    database.upgrade()
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        config = uvicorn.Config(create_app(settings), log_config=None, timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        deadline = time.monotonic() + START_WITHIN_S
        while not server.started and thread.is_alive() and time.monotonic() < deadline:
            time.sleep(0.02)
        assert server.started
        yield Service(f"http://127.0.0.1:{listening.getsockname()[1]}", settings, database, Stores(settings))
        server.should_exit = True
        thread.join()
    database.dispose()
