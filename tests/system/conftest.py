"""The dashboard that people look at in these tests, and their browser."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from dashboard_browser import CHROMIUM, FLAGS, WATCH_POLICY, Visit
from dashboard_world import World, build_world
from fastapi import FastAPI
from playwright.sync_api import Browser, sync_playwright
from serving import serve

from physworld_services.dashboard import mount


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    """The installation that all tests look at."""
    return build_world(tmp_path_factory.mktemp("dashboard"))


@pytest.fixture(scope="module")
def base(world: World) -> Iterator[str]:
    """Address of a real server with the dashboard and nothing else."""
    app = FastAPI()
    mount(app, world.settings, world.database, world.stores)
    with serve(app) as origin:
        yield f"{origin}/dashboard"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Headless Chromium with software WebGL."""
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield chromium
        chromium.close()


@pytest.fixture
def stranger(browser: Browser, base: str) -> Iterator[Visit]:
    """A tab without a session; clean at the end."""
    context = browser.new_context(viewport={"width": 1280, "height": 900}, accept_downloads=True)
    context.add_init_script(WATCH_POLICY)
    page = context.new_page()
    visit = Visit(page, base)
    page.on("console", lambda message: visit.errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: visit.errors.append(str(error)))
    page.on("request", lambda request: visit.requests.append(request.url))
    yield visit
    assert page.evaluate("window.violations") == []
    context.close()
    assert visit.errors == []
    origin = base.removesuffix("/dashboard")
    assert [url for url in visit.requests if not url.startswith((origin + "/", "blob:", "data:"))] == []


@pytest.fixture
def visit(stranger: Visit, world: World) -> Visit:
    """A tab of somebody who may write, on the overview."""
    stranger.open("/")
    stranger.login(world.writer_token)
    return stranger
