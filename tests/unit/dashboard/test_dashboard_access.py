"""Who gets in, over HTTP and without a browser: cookies, roles, origins, redirects, headers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from serving import serve

from services.dashboard import access, mount
from services.stores import Stores
from storage import api_keys
from storage.database import Database, open_database
from storage.settings import Settings

PAGE = {"accept": "text/html"}


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


def browser_at(origin: str) -> httpx.Client:
    """What a browser sends when a person opens a page."""
    return httpx.Client(base_url=origin, headers=PAGE)


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


def test_a_forged_or_expired_cookie_opens_nothing(
    client: httpx.Client, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    login(client, database)
    cookie = client.cookies[access.COOKIE]
    key_id, expiry, signature = cookie.split(".")
    for forged in (f"{key_id}.{int(expiry) + 9}.{signature}", f"{key_id}.{expiry}.", "", "x", "..", "é.1.2"):
        answer = client.get("/dashboard/", headers={"cookie": f"{access.COOKIE}={forged}".encode()})
        assert answer.status_code == 303, forged
    monkeypatch.setattr(access, "LIFETIME_SECONDS", -1)
    login(client, database)
    assert client.get("/dashboard/").status_code == 303


def test_a_session_survives_a_restart(client: httpx.Client, database: Database, settings: Settings) -> None:
    login(client, database)
    cookie = {"cookie": f"{access.COOKIE}={client.cookies[access.COOKIE]}"}
    again = FastAPI()
    mount(again, settings, database, Stores(settings))
    with serve(again) as origin, browser_at(origin) as restarted:
        assert restarted.get("/dashboard/", headers=cookie).status_code == 200
    assert (settings.data_dir / access.SECRET_NAME).stat().st_mode & 0o077 == 0


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
    answer = client.post("/dashboard/jobs/job_x/cancel", headers=from_page(client))
    assert answer.status_code == 403
    assert "this one may read" in answer.text


def test_empty_lists_say_what_to_do_next(client: httpx.Client, database: Database) -> None:
    login(client, database)
    for path in ("/dashboard/", "/dashboard/scenes", "/dashboard/datasets", "/dashboard/models"):
        assert "physworld run SCENE" in client.get(path).text


def test_a_cursor_that_no_list_gave_out_is_refused(client: httpx.Client, database: Database) -> None:
    login(client, database)
    assert client.get("/dashboard/scenes?cursor=nonsense").status_code == 400
