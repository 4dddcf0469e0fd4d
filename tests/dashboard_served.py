"""A dashboard on a real server with a person logged in, and a hand that does the work of its jobs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from fastapi import FastAPI
from serving import serve

from physworld_services.dashboard import mount
from physworld_services.stores import Stores
from physworld_storage.access import api_keys
from physworld_storage.database import Database, open_database
from physworld_storage.jobs import leases
from physworld_storage.settings import Settings

PAGE = {"accept": "text/html"}


@dataclass(frozen=True)
class Served:
    """What stands behind a dashboard, and a browser on it."""

    database: Database
    stores: Stores
    client: httpx.Client


@contextmanager
def served(folder: Path) -> Iterator[Served]:
    """An empty installation in ``folder``; who looks at it may write."""
    settings = Settings(data_dir=folder)
    database = open_database(settings)
    database.upgrade()
    stores = Stores(settings)
    app = FastAPI()
    mount(app, settings, database, stores)
    with serve(app) as origin, browser_at(origin) as client:
        login(client, database)
        yield Served(database, stores, client)
    database.dispose()


def browser_at(origin: str) -> httpx.Client:
    """What a browser sends when a person opens a page."""
    return httpx.Client(base_url=origin, headers=PAGE, timeout=60.0, trust_env=False)


def from_page(client: httpx.Client) -> dict[str, str]:
    """What a browser adds when a form of ours is sent."""
    return {"origin": str(client.base_url).rstrip("/")}


def login(
    client: httpx.Client, database: Database, role: api_keys.Role = "write", to: str = "/dashboard/"
) -> str:
    """Log in with a new key; where the answer leads to."""
    with database.session() as session:
        _, token = api_keys.create_key(session, "person", role)
    answer = client.post("/dashboard/login", data={"key": token, "next": to}, headers=from_page(client))
    assert answer.status_code == 303
    return answer.headers["location"]


def work(
    database: Database, result: Callable[[leases.Lease], dict[str, Any]], most: int | None = None
) -> None:
    """Do the work that waits, and what follows from it.

    Args:
        database: whose shards wait.
        result: of a shard.
        most: shards; None: all.
    """
    done = 0
    while most is None or done < most:
        with database.session() as session:
            waiting = leases.publishable(session)
            if not waiting:
                return
            lease = leases.claim(session, waiting[0].shard_id, "test", 60.0)
            assert lease is not None and leases.complete(session, lease, result(lease))
        done += 1


def demonstrated(lease: leases.Lease) -> dict[str, dict[str, Any]]:
    """Results of the shards of a dataset of one small episode."""
    size = {"frames": 4, "particles": 5}
    return {
        "dataset_plan": {"episodes": 1, **size},
        "episode": {"index": 0, "path": lease.shard_id, "digest": "a" * 64, "seed": 0, **size},
        "dataset_seal": {"digest": "b" * 64, "artifacts": []},
    }
