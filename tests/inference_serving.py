"""The whole of web and inference on real servers in threads of the test, with one published model behind them."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import uvicorn
from published_tiny import publish_tiny

from physworld_services.connections import Session
from physworld_services.inference.app import create_app as create_inference
from physworld_services.web import create_app as create_web
from physworld_storage.access import api_keys
from physworld_storage.database import Database, open_database
from physworld_storage.settings import Settings
from physworld_workers.stores import Stores


@dataclass
class Served:
    """Addresses, a token that may write, the model, and what lies behind."""

    url: str
    inference_url: str
    token: str
    model: str
    version: int
    settings: Settings
    database: Database
    stores: Stores

    def client(self, token: str | None = None) -> httpx.Client:
        """A client of the API."""
        headers = {"Authorization": f"Bearer {token or self.token}"}
        return httpx.Client(base_url=self.url, headers=headers, timeout=60.0, trust_env=False)


@contextmanager
def running(app: Any, listening: socket.socket) -> Iterator[None]:
    """An application on a socket that listens already."""
    server = uvicorn.Server(uvicorn.Config(app, ws=Session, log_config=None, timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive(), "the server did not start"
        time.sleep(0.02)
    try:
        yield
    finally:
        server.should_exit = True
        thread.join(timeout=30)


@contextmanager
def serve_inference(folder: Path) -> Iterator[Served]:
    """Web and inference on SQLite and a local folder."""
    with socket.create_server(("127.0.0.1", 0)) as web, socket.create_server(("127.0.0.1", 0)) as inner:
        inference_url = f"http://127.0.0.1:{inner.getsockname()[1]}"
        settings = Settings(data_dir=folder, inference_url=inference_url)
        database = open_database(settings)
        database.upgrade()
        stores = Stores(settings, database)
        model, version = publish_tiny(database, stores.artifacts)
        with database.session() as session:
            _, token = api_keys.create_key(session, "test", "admin")
        inference = create_inference(settings, database)
        with running(inference, inner), running(create_web(settings), web):
            url = f"http://127.0.0.1:{web.getsockname()[1]}"
            yield Served(url, inference_url, token, model, version, settings, database, stores)
        database.dispose()
