"""The playground as a person uses it: headless Chromium drags a grip, and the points of the world model follow."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from dashboard_browser import FLAGS, WATCH_POLICY
from inference_serving import Served, serve_inference
from playwright.sync_api import Page, expect, sync_playwright

pytestmark = pytest.mark.browser

CHROMIUM = next((path for name in ("chromium", "chromium-browser") if (path := shutil.which(name))), None)
READY_MS = 60_000
DRAG_PIXELS = (90, -70)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serve_inference(tmp_path_factory.mktemp("data")) as served:
        yield served


@pytest.fixture
def page() -> Iterator[Page]:
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1000, "height": 720})
        page.set_default_timeout(READY_MS)
        page.add_init_script(WATCH_POLICY)
        errors: list[str] = []
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        yield page
        violations = page.evaluate("window.violations")
        browser.close()
        assert errors == []
        assert violations == []


def until(page: Page, condition: Callable[[], bool]) -> None:
    """Wait in the test: a function that waits in the page would need to be compiled there, which the policy forbids."""
    deadline = time.monotonic() + READY_MS / 1000
    while not condition():
        assert time.monotonic() < deadline, "nothing happened"
        page.wait_for_timeout(50)


def place(page: Page, name: str) -> np.ndarray:
    """A point [m] that the page keeps of its newest frame."""
    return np.array([float(x) for x in page.get_attribute("[data-playground]", f"data-{name}").split()])


def test_the_points_follow_a_dragged_grip(served: Served, page: Page, tmp_path: Path) -> None:
    page.goto(f"{served.url}/dashboard/models/{served.model}/{served.version}/playground")
    page.fill("#key", served.token)
    page.click("button[type=submit]")
    page.wait_for_selector("[data-playground][data-ready]")
    until(page, lambda: int(page.get_attribute("[data-playground]", "data-frames") or 0) > 60)
    centre, grip = place(page, "centre"), place(page, "grip")

    handle = page.evaluate("""() => {
        const box = document.querySelector("[data-playground] canvas").getBoundingClientRect();
        return [box.left, box.top, box.width, box.height];
    }""")
    at = page.evaluate("() => window.playgrounds[0].seen(0)")
    x, y = handle[0] + at[0] * handle[2], handle[1] + at[1] * handle[3]
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 16):
        page.mouse.move(x + DRAG_PIXELS[0] * step / 15, y + DRAG_PIXELS[1] * step / 15)
        page.wait_for_timeout(40)
    page.wait_for_timeout(1500)
    moved, followed = place(page, "grip") - grip, place(page, "centre") - centre
    page.mouse.up()
    assert np.linalg.norm(moved) > 0.02
    assert moved[2] > 0.01  # up on the screen is up in the room
    assert followed == pytest.approx(moved, abs=0.5 * np.linalg.norm(moved))
    now = page.evaluate("() => window.playgrounds[0].seen(0)")
    pixels = np.array([(now[0] - at[0]) * handle[2], (now[1] - at[1]) * handle[3]])
    assert pixels == pytest.approx(DRAG_PIXELS, abs=15)

    rate = int(page.inner_text("[data-fps]"))
    print(f"frames per second: {rate}, hand to view: {page.inner_text('[data-delay]')} ms")
    assert rate >= 15  # software WebGL on a busy machine; the service sends 60
    page.screenshot(path=str(tmp_path / "playground.png"))

    page.focus("[data-playground] canvas")
    before = place(page, "grip")
    page.keyboard.down("ArrowRight")
    page.wait_for_timeout(600)
    page.keyboard.up("ArrowRight")
    assert place(page, "grip")[0] - before[0] > 0.01
    page.click("[data-reset]")
    expect(page.locator("[data-note]")).to_be_hidden()
    until(page, lambda: bool(np.linalg.norm(place(page, "grip") - grip) < 2e-3))
