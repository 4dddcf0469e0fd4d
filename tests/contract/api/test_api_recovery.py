"""Getting in again when no key is left, and what real processes believe, tell and write down."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path

import httpx
import pytest
from published_tiny import publish_tiny
from web_process import command, free_port, process, until_answer, web_process
from websockets.asyncio.client import connect

from physworld_services.api import attempts
from physworld_storage.access import api_keys
from physworld_storage.database import open_database
from physworld_storage.settings import Settings
from physworld_workers.stores import Stores

DEPLOYMENT = "deployment-0123456789abcdef0123456789"
RECOVER = "physworld_services.api.recover_key"


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def end_deployment_key(folder: Path) -> None:
    """As an administrator with a key of their own does."""
    database = open_database(Settings(data_dir=folder))
    with database.session() as session:
        key = api_keys.verify(session, DEPLOYMENT)
        assert key is not None
        api_keys.create_key(session, "own", "admin")
        api_keys.revoke_key(session, key.id)
    database.dispose()


def test_a_deployment_whose_first_key_was_ended_starts_and_says_how_to_get_in(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    given = {"PHYSWORLD_ADMIN_TOKEN": DEPLOYMENT}
    assert command(folder, "physworld_services.api.migrate", **given).returncode == 0
    end_deployment_key(folder)
    again = command(folder, "physworld_services.api.migrate", **given)
    assert again.returncode == 0, again.stderr
    assert "revoked at" in again.stdout and "Admin keys that are good: 1" in again.stdout
    assert f"docker compose run --rm migrate python -m {RECOVER}" in again.stdout
    with web_process(folder, tmp_path / "web.log") as url:
        assert httpx.get(f"{url}/v1/jobs", headers=bearer(DEPLOYMENT), trust_env=False).status_code == 401
        made = command(folder, RECOVER, "--name", "back in")
        assert made.returncode == 0, made.stderr
        token = made.stdout.strip()
        answer = httpx.get(f"{url}/v1/audit", headers=bearer(token), trust_env=False)
    assert answer.status_code == 200
    assert [entry["action"] for entry in answer.json()["data"][:2]] == ["key.recovered", "key.created"]
    assert token not in (tmp_path / "web.log").read_text()


def test_a_token_that_cannot_be_a_key_still_ends_the_migration(tmp_path: Path) -> None:
    refused = command(tmp_path, "physworld_services.api.migrate", PHYSWORLD_ADMIN_TOKEN="short")
    assert refused.returncode == 1
    assert "5 characters; at least 32" in refused.stderr


def test_a_key_is_recovered_only_where_there_is_a_database(tmp_path: Path) -> None:
    refused = command(tmp_path, RECOVER, "--data", str(tmp_path / "empty"))
    assert refused.returncode == 1
    assert "has revision None" in refused.stderr and refused.stdout == ""


@pytest.mark.parametrize(("trusted", "statuses"), [("", {401, 429}), ("127.0.0.1", {401})])
def test_an_address_is_believed_of_a_trusted_proxy_only(
    tmp_path: Path, trusted: str, statuses: set[int]
) -> None:
    assert command(tmp_path, "physworld_services.api.migrate").returncode == 0
    with web_process(tmp_path, tmp_path / "web.log", PHYSWORLD_TRUSTED_PROXIES=trusted) as url:
        answers = [
            httpx.get(
                f"{url}/v1/jobs",
                headers={**bearer(f"guess {turn}"), "X-Forwarded-For": f"10.0.0.{turn}"},
                trust_env=False,
            )
            for turn in range(attempts.PER_ADDRESS + 2)
        ]
        over_tls = httpx.get(
            f"{url}/dashboard/login", headers={"X-Forwarded-Proto": "https"}, trust_env=False
        )
    assert {answer.status_code for answer in answers} == statuses
    assert "Server" not in answers[0].headers
    assert ("Strict-Transport-Security" in over_tls.headers) == bool(trusted)
    log = (tmp_path / "web.log").read_text()
    assert log.count('"status": 401') == sum(answer.status_code == 401 for answer in answers)
    assert '"status": 429' not in log  # a flood of them fills no disk


@pytest.mark.parametrize("level", ["info", "debug"])
def test_no_log_holds_a_ticket_or_a_key(tmp_path: Path, level: str) -> None:
    folder, log = tmp_path / "data", tmp_path / "all.log"
    settings = Settings(data_dir=folder)
    database = open_database(settings)
    database.upgrade()
    model, _ = publish_tiny(database, Stores(settings, database).artifacts)
    with database.session() as session:
        _, token = api_keys.create_key(session, "robot", "write")
    database.dispose()
    port = free_port()
    inner = {"PHYSWORLD_INFERENCE_URL": f"http://127.0.0.1:{port}", "PHYSWORLD_LOG_LEVEL": level}
    serve = ("physworld_services.inference", "serve", "--port", str(port))
    with process(folder, log, *serve, **inner) as inference, web_process(folder, log, **inner) as url:
        until_answer(f"http://127.0.0.1:{port}/health", inference)
        asked = httpx.post(
            f"{url}/v1/live/tickets", json={"model": model}, headers=bearer(token), trust_env=False
        )
        path, ticket = asked.json()["path"], asked.json()["ticket"]

        async def enter(headers: dict[str, str], path: str) -> None:
            address = url.replace("http", "ws", 1) + path
            async with connect(address, proxy=None, additional_headers=headers) as socket:
                assert json.loads(await socket.recv())["type"] == "ready"

        asyncio.run(enter({}, path))
        asyncio.run(enter(bearer(token), path.partition("&ticket=")[0]))
    written = log.read_text()
    assert "/v1/jobs" not in written and "tickets" in written  # it is the log of this
    assert ticket not in written and token not in written
    assert re.findall(r"(?i)ticket(?:=|%3d)[\w-]{20,}", written) == []
