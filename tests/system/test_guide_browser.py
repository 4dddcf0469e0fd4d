"""The guide in a browser: its policy lets through all that it needs, and the search finds words without a network."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Literal

import pytest
from dashboard_browser import WATCH_POLICY
from fastapi import FastAPI
from playwright.sync_api import Browser, Page, expect
from serving import serve

from physworld_services import guide

pytestmark = [pytest.mark.slow, pytest.mark.browser]

ROOT = Path(__file__).resolve().parents[2]
AXE = (files("axe_playwright_python") / "axe.min.js").read_text()
WCAG = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Of a server with the built guide and nothing else."""
    site = tmp_path_factory.mktemp("guide")
    build = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--quiet",
        "--clean",
        "--site-dir",
        str(site),
    ]
    subprocess.run(build, cwd=ROOT, check=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    app = FastAPI()
    guide.mount(app, site)
    with serve(app) as url:
        yield f"{url}{guide.BASE}"


@pytest.fixture
def page(browser: Browser, address: str) -> Iterator[Page]:
    """A tab that may have no error, no violation of the policy and no request to another server at its end."""
    wrong: list[str] = []
    tab = browser.new_page(viewport={"width": 1440, "height": 900})
    tab.add_init_script(WATCH_POLICY)
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    tab.on(
        "request",
        lambda asked: None if asked.url.startswith((address, "data:", "blob:")) else wrong.append(asked.url),
    )
    yield tab
    assert wrong + tab.evaluate("window.violations") == []
    tab.close()


def test_the_search_finds_a_page(page: Page, address: str) -> None:
    page.goto(f"{address}/")
    page.get_by_placeholder("Search").first.click()
    page.keyboard.type("final_data")
    found = page.locator(".md-search-result__item", has_text="PhysTwin").first
    found.locator("a").first.click()
    expect(page.locator("article")).to_contain_text("final_data")


def test_a_notebook_shows_its_figures(page: Page, address: str) -> None:
    page.goto(f"{address}/notebooks/recording_to_model.html")
    figure = page.locator("article img").first
    expect(figure).to_be_visible()
    assert figure.evaluate("image => image.complete && image.naturalWidth") > 100


def test_a_film_of_the_gallery_plays(page: Page, address: str) -> None:
    page.goto(f"{address}/gallery.html")
    film = page.locator("video").first
    film.evaluate("film => film.play()")
    assert film.evaluate("film => film.videoWidth") == 640


@pytest.mark.parametrize(
    "path", ["", "models.html", "reference/commands.html", "notebooks/demonstrations.html"]
)
def test_pages_are_no_wider_than_a_phone(page: Page, address: str, path: str) -> None:
    page.set_viewport_size({"width": 360, "height": 800})
    page.goto(f"{address}/{path}")
    assert page.evaluate("document.documentElement.scrollWidth") <= 360


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(
    "path", ["", "tutorial.html", "gallery.html", "dashboard.html", "notebooks/missing_effect.html"]
)
def test_axe_finds_nothing(
    browser: Browser, address: str, path: str, scheme: Literal["light", "dark"]
) -> None:
    tab = browser.new_page(color_scheme=scheme)
    tab.goto(f"{address}/{path}")
    session = tab.context.new_cdp_session(
        tab
    )  # the pages' policy lets no script in, a debugger's does not ask
    session.send("Runtime.evaluate", {"expression": AXE})
    asked = (
        f"axe.run(document, {{runOnly: {{type: 'tag', values: {json.dumps(WCAG)}}}}}).then(r => r.violations)"
    )
    answer = session.send(
        "Runtime.evaluate", {"expression": asked, "awaitPromise": True, "returnByValue": True}
    )
    assert [(rule["id"], len(rule["nodes"])) for rule in answer["result"]["value"]] == []
    tab.close()
