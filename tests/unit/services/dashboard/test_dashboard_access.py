"""Who gets in, over HTTP and without a browser: cookies, roles, origins, redirects, headers."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import httpx
import pytest
from dashboard_served import PAGE, browser_at, from_page, login
from fastapi import FastAPI
from serving import serve
from sqlalchemy import select

from physworld_services.dashboard import access, mount
from physworld_services.stores import Stores
from physworld_services.web import create_app
from physworld_storage.access import api_keys, sessions
from physworld_storage.database import Database, open_database
from physworld_storage.settings import Settings
from physworld_storage.tables import SessionRow, utc_now

pytestmark = pytest.mark.slow


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path)


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    database = open_database(settings)
    database.upgrade()
    yield database
    database.dispose()


@pytest.fixture
def app(settings: Settings, database: Database) -> FastAPI:
    app = FastAPI()
    mount(app, settings, database, Stores(settings))
    return app


@pytest.fixture
def client(app: FastAPI) -> Iterator[httpx.Client]:
    with serve(app) as origin, browser_at(origin) as client:
        yield client


def test_every_route_but_login_logout_and_static_needs_a_session(app: FastAPI, client: httpx.Client) -> None:
    dashboard = next(route.app for route in app.routes if getattr(route, "name", "") == "dashboard")
    paths = {path for path, operations in dashboard.openapi()["paths"].items() if "get" in operations}
    assert len(paths) > 15
    for path in paths - {"/login"}:
        filled = re.sub(r"\{(sha256)\}", "0" * 64, path)
        filled = re.sub(r"\{(index|number)\}", "1", filled)
        filled = re.sub(r"\{\w+\}", "x", filled)
        page = client.get(f"/dashboard{filled}")
        assert page.status_code == 303, path
        assert page.headers["location"].startswith("/dashboard/login?next="), path
        assert client.get(f"/dashboard{filled}", headers={"accept": "*/*"}).status_code == 401, path


def test_the_policy_is_on_every_answer(client: httpx.Client) -> None:
    for path in ("/dashboard/login", "/dashboard/nothing", "/dashboard/static/app.js", "/dashboard/"):
        headers = client.get(path).headers
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"


def test_a_session_opens_the_pages_and_a_revoked_key_closes_them(
    client: httpx.Client, database: Database
) -> None:
    login(client, database)
    assert client.get("/dashboard/").status_code == 200
    with database.session() as session:
        key = api_keys.list_keys(session).data[0]
        api_keys.revoke_key(session, key.id)
    assert client.get("/dashboard/").status_code == 303


def test_a_made_up_or_expired_session_opens_nothing(
    client: httpx.Client, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    login(client, database)
    text = client.cookies[access.COOKIE]
    with database.session() as session:
        digest = session.scalars(select(SessionRow.digest)).one()
    for forged in (text[:-1], text + "A", digest, "", "x", "..", "é.1.2"):
        answer = client.get("/dashboard/", headers={"cookie": f"{access.COOKIE}={forged}".encode()})
        assert answer.status_code == 303, forged
    assert client.get("/dashboard/").status_code == 200
    for later in (sessions.IDLE, sessions.LIFETIME):
        with monkeypatch.context() as clock:
            clock.setattr(sessions, "utc_now", lambda later=later: utc_now() + later)
            assert client.get("/dashboard/").status_code == 303
    assert client.get("/dashboard/").status_code == 200


def test_a_session_that_is_used_does_not_fall_idle_but_ends_after_twelve_hours(
    client: httpx.Client, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    login(client, database)
    began, used = utc_now(), timedelta(0)
    while used < sessions.LIFETIME - 2 * sessions.IDLE:
        used += sessions.IDLE - timedelta(minutes=1)
        monkeypatch.setattr(sessions, "utc_now", lambda used=used: began + used)
        assert client.get("/dashboard/").status_code == 200, used
    monkeypatch.setattr(sessions, "utc_now", lambda: began + sessions.LIFETIME + timedelta(seconds=5))
    assert client.get("/dashboard/").status_code == 303


def test_a_log_out_ends_the_session_wherever_its_cookie_is(client: httpx.Client, database: Database) -> None:
    login(client, database)
    copied = {"cookie": f"{access.COOKIE}={client.cookies[access.COOKIE]}"}
    assert client.post("/dashboard/logout", headers=from_page(client)).status_code == 303
    assert access.COOKIE not in client.cookies
    assert client.get("/dashboard/", headers=copied).status_code == 303
    with database.session() as session:
        assert session.scalars(select(SessionRow)).all() == []


def test_a_log_out_everywhere_ends_all_sessions_of_the_key_and_no_other(
    app: FastAPI, client: httpx.Client, database: Database
) -> None:
    with database.session() as session:
        _, token = api_keys.create_key(session, "person", "read")
    with browser_at(str(client.base_url)) as second, browser_at(str(client.base_url)) as stranger:
        for browser in (client, second):
            browser.post("/dashboard/login", data={"key": token}, headers=from_page(client))
        login(stranger, database)
        client.post("/dashboard/logout", data={"everywhere": "true"}, headers=from_page(client))
        assert second.get("/dashboard/").status_code == 303
        assert stranger.get("/dashboard/").status_code == 200


def test_a_viewer_sees_the_sessions_of_the_key_and_ends_one_and_only_those(
    client: httpx.Client, database: Database
) -> None:
    with database.session() as session:
        _, token = api_keys.create_key(session, "person", "read")
    with browser_at(str(client.base_url)) as second, browser_at(str(client.base_url)) as stranger:
        for browser in (client, second):
            browser.post("/dashboard/login", data={"key": token}, headers=from_page(client))
        login(stranger, database)
        page = client.get("/dashboard/sessions").text
        assert page.count("127.0.0.1") == 2 and page.count("this one") == 1
        (end,) = re.findall(r"/dashboard/sessions/[0-9a-f]{64}/end", page)
        assert stranger.post(end, headers=from_page(client)).status_code == 303
        assert second.get("/dashboard/").status_code == 200
        assert client.post(end, headers={}).status_code == 403
        assert client.post(end, headers=from_page(client)).status_code == 303
        assert second.get("/dashboard/").status_code == 303
        assert client.get("/dashboard/").status_code == 200
        assert second.cookies[access.COOKIE] not in page and token not in page


def test_a_login_begins_another_session_and_ends_the_one_before(
    client: httpx.Client, database: Database
) -> None:
    login(client, database)
    before = client.cookies[access.COOKIE]
    login(client, database)
    assert client.cookies[access.COOKIE] != before
    stale = {"cookie": f"{access.COOKIE}={before}"}
    assert client.get("/dashboard/", headers=stale).status_code == 303


def test_over_tls_the_cookie_is_bound_to_the_host_and_the_header_says_tls_only(
    settings: Settings, database: Database
) -> None:
    with database.session() as session:
        _, token = api_keys.create_key(session, "person", "read")

    async def over_tls() -> tuple[httpx.Response, httpx.Response]:
        transport = httpx.ASGITransport(create_app(settings))
        async with httpx.AsyncClient(transport=transport, base_url="https://host", headers=PAGE) as browser:
            form = {"data": {"key": token}, "headers": {"origin": "https://host"}}
            return await browser.post("/dashboard/login", **form), await browser.get("/dashboard/")

    entered, page = asyncio.run(over_tls())
    name, *attributes = (part.strip() for part in entered.headers["set-cookie"].split(";"))
    assert name.startswith("__Host-physworld_session=")
    assert {"HttpOnly", "Path=/", "SameSite=strict", "Secure"} <= set(attributes)
    assert page.status_code == 200
    assert page.headers["strict-transport-security"].startswith("max-age=31536000")


def test_the_cookie_holds_no_key_and_the_database_no_cookie(
    client: httpx.Client, database: Database, settings: Settings
) -> None:
    login(client, database)
    text = client.cookies[access.COOKIE]
    assert len(text) >= 43 and "key_" not in text
    for file in settings.data_dir.rglob("*"):
        assert not file.is_file() or text.encode() not in file.read_bytes(), file


def test_a_session_survives_a_restart(client: httpx.Client, database: Database, settings: Settings) -> None:
    login(client, database)
    cookie = {"cookie": f"{access.COOKIE}={client.cookies[access.COOKIE]}"}
    again = FastAPI()
    mount(again, settings, database, Stores(settings))
    with serve(again) as origin, browser_at(origin) as restarted:
        assert restarted.get("/dashboard/", headers=cookie).status_code == 200


@pytest.mark.parametrize(
    "elsewhere",
    [
        "https://example.org/",
        "//example.org",
        "/dashboard//example.org",
        "/dashboard/\\example.org",
        "/v1/jobs",
    ],
)
def test_a_login_leads_nowhere_else(client: httpx.Client, database: Database, elsewhere: str) -> None:
    assert login(client, database, to=elsewhere) == "/dashboard/"


def test_a_form_of_another_site_changes_nothing(client: httpx.Client, database: Database) -> None:
    login(client, database)
    for headers in (
        {"origin": "https://example.org"},
        {"origin": "null"},
        {},
        {"sec-fetch-site": "cross-site", **from_page(client)},
        {"sec-fetch-site": "same-site", **from_page(client)},
    ):
        answer = client.post("/dashboard/jobs/job_x/cancel", headers=headers)
        assert answer.status_code == 403, headers
        assert client.post("/dashboard/logout", headers=headers).status_code == 403, headers
    assert client.post("/dashboard/jobs/job_x/cancel", headers=from_page(client)).status_code == 404


def test_a_reader_cancels_nothing(client: httpx.Client, database: Database) -> None:
    login(client, database, "read")
    for act in ("cancel", "retry"):
        answer = client.post(f"/dashboard/jobs/job_x/{act}", headers=from_page(client))
        assert answer.status_code == 403
        assert "this one may read" in answer.text


def test_empty_lists_say_what_to_do_next(client: httpx.Client, database: Database) -> None:
    login(client, database, "write")
    for path in ("/dashboard/", "/dashboard/scenes"):
        assert 'action="/dashboard/scenes/sample"' in client.get(path).text
    for path, kind in (("datasets", "dataset"), ("models", "pipeline"), ("fits", "fit"), ("plans", "plan")):
        assert f'href="/dashboard/start/{kind}"' in client.get(f"/dashboard/{path}").text


def test_a_cursor_that_no_list_gave_out_is_refused(client: httpx.Client, database: Database) -> None:
    login(client, database)
    assert client.get("/dashboard/scenes?cursor=nonsense").status_code == 400
