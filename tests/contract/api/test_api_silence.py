"""A database or a store that is silent: not dead, so that nothing ever fails by itself. Answers come in time anyway."""

from __future__ import annotations

import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import boto3
import httpx
import pytest
from api_service import Service, assert_problem, bundle, upload
from conftest import serve
from sqlalchemy import make_url

from benchmarks.service.chaos.proxy import FrozenProxy
from physworld_storage.settings import Settings

WITHIN_S = 15.0
"""Of a request; it should take 8 s at most, and the machine may do other things."""
READY_WITHIN_S = 4.0
"""Of a readiness check, which should take 1.5 s."""
WRITERS = 45


@pytest.fixture
def far_database(postgres_url: str, tmp_path: Path) -> Iterator[tuple[Service, FrozenProxy]]:
    """A service whose Postgres is behind a proxy."""
    url = make_url(postgres_url)
    with FrozenProxy(str(url.host), url.port or 5432) as proxy:
        behind = url.set(host=proxy.host, port=proxy.port).render_as_string(hide_password=False)
        for service in serve(Settings(data_dir=tmp_path / "data", database_url=behind)):
            yield service, proxy
            proxy.thaw()


@pytest.fixture
def bucket_server(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """The address of an S3 server with the bucket ``recordings``, and its process."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with (tmp_path / "s3.log").open("wb") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], stdout=log, stderr=log
        )
    endpoint = f"http://127.0.0.1:{port}"
    deadline = time.monotonic() + 60.0
    while True:
        assert server.poll() is None and time.monotonic() < deadline
        try:
            httpx.get(endpoint, trust_env=False)
            break
        except httpx.TransportError:
            time.sleep(0.1)
    keys = {"aws_access_key_id": "test-access", "aws_secret_access_key": "test-secret"}
    client = boto3.client("s3", endpoint_url=endpoint, region_name="us-east-1", **keys)
    client.create_bucket(Bucket="recordings")
    client.close()
    yield endpoint, server
    server.send_signal(signal.SIGCONT)
    server.terminate()
    server.wait(30)


@pytest.fixture
def far_store(
    bucket_server: tuple[str, subprocess.Popen[bytes]], tmp_path: Path
) -> Iterator[tuple[Service, subprocess.Popen[bytes]]]:
    """A service whose store is a bucket, and the process of the bucket's server."""
    endpoint, server = bucket_server
    settings = Settings(
        data_dir=tmp_path / "data",
        store_url=f"s3://recordings/{tmp_path.name}",
        s3_endpoint=endpoint,
        s3_access_key_id="test-access",
        s3_secret_access_key="test-secret",
    )
    for service in serve(settings):
        yield service, server
        server.send_signal(signal.SIGCONT)


def test_a_silent_postgres_is_503_in_time_and_works_again_once_it_speaks(
    far_database: tuple[Service, FrozenProxy],
) -> None:
    service, proxy = far_database
    with service.client("admin") as client:
        assert client.get("/v1/jobs").status_code == 200
        proxy.freeze()
        answers = _at_once(service, "/v1/jobs", 60)
        for answer, seconds in answers:
            problem = _is_unavailable(answer, "database_unavailable")
            assert "database" in problem["detail"] and str(proxy.port) not in problem["detail"]
            assert seconds < WITHIN_S
        _assert_ready_says(service, {"database"})
        started = time.monotonic()
        assert client.get("/health/live").status_code == 200
        assert "physworld_database_up 0.0" in client.get("/metrics").text
        assert time.monotonic() - started < WITHIN_S
        proxy.thaw()
        _until_ready(client)
        assert client.get("/v1/jobs").status_code == 200
        assert "physworld_database_up 1.0" in client.get("/metrics").text


def test_readiness_while_requests_hang(far_database: tuple[Service, FrozenProxy]) -> None:
    service, proxy = far_database
    token = service.token("admin")
    proxy.freeze()
    hanging = [threading.Thread(target=_ask, args=(service.url, "/v1/jobs", token)) for _ in range(60)]
    for thread in hanging:
        thread.start()
    before = threading.active_count()
    with ThreadPoolExecutor(20) as pool:
        for answer, seconds in pool.map(
            lambda _: _ask(service.url, "/health/ready", None), range(20), timeout=60
        ):
            problem = assert_problem(answer, 503, "database_unavailable")
            assert problem["checks"]["store"] == "ok"
            assert seconds < READY_WITHIN_S
        probes = [thread.name for thread in threading.enumerate() if thread.name.startswith("probe-")]
        assert len(probes) <= 2 and threading.active_count() < before + 60
    assert _ask(service.url, "/health/live", None)[1] < READY_WITHIN_S
    for thread in hanging:
        thread.join(60)


def test_a_stopped_store_is_503_in_time_and_works_again_once_it_goes_on(
    far_store: tuple[Service, subprocess.Popen[bytes]],
) -> None:
    service, server = far_store
    with service.client("admin") as client:
        assert upload(client, bundle("kept")).status_code == 201
        archive = service.stores.artifacts.put_bytes(b"kept", "kept.bin").sha256
        server.send_signal(signal.SIGSTOP)
        for answer, seconds in _at_once(service, f"/v1/artifacts/{archive}", 45):
            problem = _is_unavailable(answer, "store_read_failed")
            assert "store" in problem["detail"] and "127.0.0.1" not in problem["detail"]
            assert seconds < WITHIN_S
        started = time.monotonic()
        _is_unavailable(upload(client, bundle("another")), "store_")
        assert time.monotonic() - started < 2 * WITHIN_S
        _assert_ready_says(service, {"store"})
        assert client.get("/v1/jobs").status_code == 200
        server.send_signal(signal.SIGCONT)
        _until_ready(client)
        assert client.get(f"/v1/artifacts/{archive}").status_code == 200
        assert upload(client, bundle("another")).status_code == 201


def test_writers_on_sqlite_do_not_wait_for_a_minute(tmp_path: Path) -> None:
    for service in serve(Settings(data_dir=tmp_path / "data")):
        token = service.token("admin")
        held = sqlite3.connect(tmp_path / "data" / "physworld.db", isolation_level=None)
        held.execute("BEGIN IMMEDIATE")
        body = {"name": "another", "role": "read"}
        with ThreadPoolExecutor(WRITERS) as pool:
            asked = [pool.submit(_ask, service.url, "/v1/keys", token, body) for _ in range(WRITERS)]
            reading = [pool.submit(_ask, service.url, "/v1/jobs", token) for _ in range(3)]
            answers = [one.result() for one in asked]
            assert {one.result()[0].status_code for one in reading} <= {200, 503}
        for answer, seconds in answers:
            _is_unavailable(answer, "database_unavailable")
            assert seconds < WITHIN_S
        held.execute("ROLLBACK")
        held.close()
        assert _ask(service.url, "/v1/keys", token, body)[0].status_code == 201


def _ask(
    url: str, path: str, token: str | None, body: dict[str, str] | None = None
) -> tuple[httpx.Response, float]:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    started = time.monotonic()
    method = "GET" if body is None else "POST"
    answer = httpx.request(method, url + path, headers=headers, json=body, timeout=120.0, trust_env=False)
    return answer, time.monotonic() - started


def _at_once(service: Service, path: str, count: int) -> list[tuple[httpx.Response, float]]:
    token = service.tokens["admin"]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(lambda _: _ask(service.url, path, token), range(count)))


def _is_unavailable(answer: httpx.Response, code: str) -> dict[str, str]:
    problem: dict[str, str] = answer.json()
    assert answer.status_code == 503, answer.text
    assert answer.headers["Retry-After"] and problem["code"].startswith(code)
    return problem


def _assert_ready_says(service: Service, hanging: set[str]) -> None:
    answer, seconds = _ask(service.url, "/health/ready", None)
    assert answer.status_code == 503 and seconds < READY_WITHIN_S
    checks = answer.json()["checks"]
    assert {name for name, state in checks.items() if state != "ok"} == hanging
    assert "127.0.0.1" not in answer.text and "localhost" not in answer.text


def _until_ready(client: httpx.Client) -> None:
    deadline = time.monotonic() + 30.0
    while client.get("/health/ready").status_code != 200:
        assert time.monotonic() < deadline
        time.sleep(0.2)
