"""What lasts ends with what opened it: event streams, live parts of pages and live sessions."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import httpx
import pytest
from api_service import Service, scene_id
from inference_serving import Served, serve_inference
from serving import log_in
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from physworld_storage.access import api_keys

WITHIN_S = 5.0
BUSY_S = 10.0  # more, on a machine that does other things
QUIET_S = 3.0


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serve_inference(tmp_path_factory.mktemp("data")) as served:
        yield served


@contextmanager
def followed(url: str, headers: dict[str, str]) -> Iterator[Callable[[float], bool]]:
    """Read a stream of events in a thread; whether it has ended within so many seconds."""
    begun, over = threading.Event(), threading.Event()

    def read() -> None:
        with httpx.stream("GET", url, headers=headers, timeout=60.0, trust_env=False) as answer:
            assert answer.status_code == 200
            for _ in answer.iter_raw():
                begun.set()
        over.set()  # only where the answer ended as it should, not by a cut connection

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    assert begun.wait(30.0)
    yield over.wait
    thread.join(60.0)


def new_key(client: httpx.Client, role: str = "write") -> tuple[str, str]:
    made = client.post("/v1/keys", json={"name": "robot", "role": role}).json()
    return made["id"], made["token"]


def waiting_job(client: httpx.Client) -> str:
    """A job that nobody will do."""
    job = client.post("/v1/fits", json={"scene_id": scene_id(client)}).json()["id"]
    return f"/v1/jobs/{job}/events"


@pytest.mark.parametrize("how", ["revoked", "rotated", "expired"])
def test_an_event_stream_ends_with_its_key(
    service: Service, client: httpx.Client, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (key, token), events = new_key(client), waiting_job(client)
    with followed(f"{service.url}{events}", {"Authorization": f"Bearer {token}"}) as ended:
        assert not ended(QUIET_S)
        started = time.monotonic()
        if how == "revoked":
            assert client.delete(f"/v1/keys/{key}").status_code == 200
        elif how == "rotated":
            assert client.post(f"/v1/keys/{key}/rotate", json={"grace_minutes": 0}).status_code == 200
        else:
            with service.database.session() as session:
                row = session.get(api_keys.ApiKeyRow, key)
                assert row is not None
                row.expires_at = row.created_at
        assert ended(WITHIN_S + BUSY_S)
    print(f"{how}: the stream ended after {time.monotonic() - started:.1f} s")


def test_a_rotation_with_grace_and_the_end_of_another_key_end_nothing(
    service: Service, client: httpx.Client
) -> None:
    (key, token), (other, _), events = new_key(client), new_key(client), waiting_job(client)
    with followed(f"{service.url}{events}", {"Authorization": f"Bearer {token}"}) as ended:
        client.post(f"/v1/keys/{key}/rotate", json={"grace_minutes": 5})
        client.delete(f"/v1/keys/{other}")
        assert not ended(WITHIN_S)
        client.delete(f"/v1/keys/{key}")
        assert ended(WITHIN_S + BUSY_S)


@pytest.mark.parametrize("how", ["log-out", "revoked"])
def test_a_live_part_of_a_page_ends_with_its_session(
    service: Service, client: httpx.Client, how: str
) -> None:
    key, token = new_key(client)
    cookie = log_in(service.url, token)
    with followed(f"{service.url}/dashboard/live/jobs", cookie) as ended:
        assert not ended(QUIET_S)
        if how == "log-out":
            logout = httpx.post(f"{service.url}/dashboard/logout", headers=cookie, trust_env=False)
            assert logout.status_code == 303
        else:
            client.delete(f"/v1/keys/{key}")
        assert ended(WITHIN_S + BUSY_S)


@pytest.mark.parametrize("way", ["ticket", "header", "page"])
def test_a_live_session_ends_with_what_opened_it(served: Served, way: str) -> None:
    with served.client() as client:
        key, token = new_key(client)
        headers = {"Authorization": f"Bearer {token}"}
        path, given = f"/v1/live?model={served.model}&version={served.version}", dict[str, str]()
        if way == "header":
            given = headers
        elif way == "ticket":
            asked = client.post("/v1/live/tickets", json={"model": served.model}, headers=headers)
            path = asked.json()["path"]
        else:
            cookie = log_in(served.url, token)
            page = f"/dashboard/models/{served.model}/{served.version}/live"
            path = client.post(page, headers=cookie).json()["path"]

        async def work() -> tuple[int, str]:
            address = served.url.replace("http", "ws", 1) + path
            async with connect(address, proxy=None, additional_headers=given) as socket:
                assert json.loads(await socket.recv())["type"] == "ready"
                if way == "page":
                    await asyncio.to_thread(client.post, "/dashboard/logout", headers=cookie)
                else:
                    await asyncio.to_thread(client.delete, f"/v1/keys/{key}")
                with pytest.raises(ConnectionClosed) as ended:
                    while True:
                        await socket.recv()
                assert ended.value.rcvd is not None
                return ended.value.rcvd.code, ended.value.rcvd.reason

        code, reason = asyncio.run(asyncio.wait_for(work(), WITHIN_S + BUSY_S))
    assert code == 1008
    assert reason.startswith("unauthenticated: the key or session")
