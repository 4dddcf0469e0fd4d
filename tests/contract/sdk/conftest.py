"""The real web application on a free loopback port, for the SDK's tests."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import pytest
import uvicorn
from physworld_client import Client
from sdk_service import Service

from physworld_services.stores import Stores
from physworld_services.web import create_app
from physworld_storage.access.api_keys import create_key
from physworld_storage.database import open_database
from physworld_storage.settings import Settings

START_WITHIN_S = 60.0


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """One service for the tests of a file."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("data"))
    database = open_database(settings)
    database.upgrade()
    with database.session() as session:
        _, token = create_key(session, "test", "admin")
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
        url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        yield Service(url, token, database, Stores(settings))
        server.should_exit = True
        thread.join()
    database.dispose()


@pytest.fixture
def client(service: Service) -> Iterator[Client]:
    """A client with the admin key."""
    with service.client() as client:
        yield client
