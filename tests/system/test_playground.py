"""The playground as a person uses it: headless Chromium drags a grip, and the points of the world model follow."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from dashboard_browser import FLAGS, WATCH_POLICY, Visit
from inference_serving import Served, serve_inference
from PIL import Image
from playwright.sync_api import Page, expect, sync_playwright
from published_tiny import DRAG, publish_tiny, tiny_model
from test_dashboard_accessible import WIDTHS, violations

from physworld.video.gaussians import gaussians_at_points, to_ply

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


def enter(served: Served, page: Page) -> None:
    """The playground, once frames and what belongs to the model have come."""
    page.goto(f"{served.url}/dashboard/models/{served.model}/{served.version}/playground")
    page.fill("#key", served.token)
    page.click("button[type=submit]")
    page.wait_for_selector("[data-playground][data-ready][data-accompanied]")
    until(page, lambda: int(page.get_attribute("[data-playground]", "data-frames") or 0) > 60)


def at_grip(page: Page) -> tuple[float, float]:
    """Where the first grip is drawn in the window [px]."""
    left, top, width, height = page.evaluate("""() => {
        const box = document.querySelector("[data-playground] canvas").getBoundingClientRect();
        return [box.left, box.top, box.width, box.height];
    }""")
    share = page.evaluate("() => window.playgrounds[0].seen(0)")
    return left + share[0] * width, top + share[1] * height


def test_the_points_follow_a_dragged_grip(served: Served, page: Page, tmp_path: Path) -> None:
    enter(served, page)
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
    assert rate > 0
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


def test_a_slider_changes_the_body_and_a_new_session_keeps_it(served: Served, page: Page) -> None:
    sent: list[str] = []
    page.on("websocket", lambda socket: socket.on("framesent", lambda said: sent.append(str(said))))
    enter(served, page)
    sliders = page.locator("[data-factors] label")
    expect(sliders).to_have_text(["Stiffness× 1.00", "Density× 1.00"])
    slider = sliders.nth(0).locator("input")
    slider.focus()
    slider.press("End")
    expect(sliders.nth(0)).to_contain_text("× 4.00")
    asked = {"type": "factors", "factors": {"stiffness": 4, "density": 1}, "strengths": {}}
    until(page, lambda: any("factors" in said and json.loads(said) == asked for said in sent))
    frames = int(page.get_attribute("[data-playground]", "data-frames") or 0)
    until(page, lambda: int(page.get_attribute("[data-playground]", "data-frames") or 0) > frames + 10)
    sent.clear()
    page.evaluate("() => window.playgrounds[0].socket.close()")
    expect(page.locator("[data-note]")).to_contain_text("The session ended")
    page.click("[data-reset]")
    until(page, lambda: any("factors" in said and json.loads(said) == asked for said in sent))


def test_a_strength_of_an_effect_has_a_slider_over_what_the_training_covered(
    served: Served, page: Page
) -> None:
    model, version = publish_tiny(served.database, served.stores.artifacts, name="tiny-dragged", dragged=True)
    sent: list[str] = []
    page.on("websocket", lambda socket: socket.on("framesent", lambda said: sent.append(str(said))))
    enter(dataclasses.replace(served, model=model, version=version), page)
    label = page.locator("[data-factors] label", has_text="Air drag linear: rate")
    expect(label).to_have_text("Air drag linear: rate2 1/s")
    expect(label).to_have_attribute("title", "0.5 to 3.5 1/s are what the training covered")
    slider = label.locator("input")
    for key, words, value in (("End", "3.5 1/s", 3.5), ("Home", "0.5 1/s", 0.5)):
        slider.press(key)
        expect(label).to_contain_text(words)
        asked = {
            "factors": {"stiffness": 1, "density": 1},
            "strengths": {f"{DRAG.effect}.{DRAG.name}": value},
        }
        until(
            page,
            lambda asked=asked: any(
                "strengths" in said and json.loads(said) == {"type": "factors"} | asked for said in sent
            ),
        )
    frames = int(page.get_attribute("[data-playground]", "data-frames") or 0)
    until(page, lambda: int(page.get_attribute("[data-playground]", "data-frames") or 0) > frames + 30)
    expect(page.locator("[data-note]")).to_be_hidden()


def test_a_box_opens_a_grip_and_start_again_closes_it(served: Served, page: Page) -> None:
    bar = {"name": "tiny-between", "kind": "between two grips"}
    model, version = publish_tiny(served.database, served.stores.artifacts, **bar)
    enter(dataclasses.replace(served, model=model, version=version), page)
    far, first = (page.get_by_label(f"Grip {number} holds") for number in (2, 1))
    expect(far).to_be_checked()
    expect(first).to_be_disabled()  # there is no model for the second grip alone
    high = page.evaluate("() => window.playgrounds[0].places[1].z")
    far.uncheck()
    until(page, lambda: bool(page.evaluate("() => window.playgrounds[0].places[1].z") < high - 3e-3))
    page.click("[data-reset]")
    expect(far).to_be_checked()
    until(page, lambda: bool(abs(page.evaluate("() => window.playgrounds[0].places[1].z") - high) < 1e-6))
    page.get_by_label("Twin, live").check()
    expect(page.locator("[data-twin]")).to_contain_text("real time")
    far.uncheck()
    expect(page.locator("[data-twin]")).to_contain_text("a twin that is run live cannot let go")
    expect(page.locator("[data-note]")).to_be_hidden()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_axe_finds_nothing_beside_a_live_session(
    served: Served, page: Page, scheme: Literal["light", "dark"], width: int
) -> None:
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 900})
    enter(served, page)
    expect(page.locator("[data-factors] label")).to_have_count(2)
    expect(page.locator("label[data-for=twin]")).to_have_text("Twin (recorded motion)")
    assert violations(Visit(page, served.url)) == []


def test_a_still_pointer_leaves_a_still_grip(served: Served, page: Page) -> None:
    enter(served, page)
    x, y = at_grip(page)
    before = place(page, "grip")
    page.mouse.move(x + 9, y + 7)  # beside its middle
    page.mouse.down()
    page.mouse.move(x + 9, y + 7)
    page.wait_for_timeout(1000)
    assert np.linalg.norm(place(page, "grip") - before) < 1e-3
    page.mouse.move(x + 69, y + 7, steps=6)
    page.wait_for_timeout(1500)
    places = []
    for _ in range(10):
        places.append(place(page, "grip"))
        page.wait_for_timeout(60)
    page.mouse.up()
    assert np.linalg.norm(places[-1] - before) > 5e-3
    assert np.ptp(places, axis=0).max() < 5e-4  # it does not swing around the pointer


def test_the_body_is_a_surface_that_moves_with_the_vertices(served: Served, page: Page) -> None:
    enter(served, page)
    state = """() => { const it = window.playgrounds[0]; const out = it.surface.attribute.array; let mean = [0, 0, 0];
        for (let i = 0; i < out.length; i += 1) mean[i % 3] += 3 * out[i] / out.length;
        return { mesh: it.surface.mesh.visible, dots: it.body.points.visible, mean }; }"""
    shown = page.evaluate(state)
    assert shown["mesh"] and not shown["dots"]
    until(page, lambda: bool(np.linalg.norm(page.evaluate(state)["mean"] - place(page, "centre")) < 0.02))
    page.get_by_label("as a surface").uncheck()
    shown = page.evaluate(state)
    assert shown["dots"] and not shown["mesh"]


def test_the_recorded_motion_is_driven_beside_the_recording(served: Served, page: Page) -> None:
    enter(served, page)
    expect(page.get_by_label("Recording")).to_be_checked()
    ghost = "() => { const it = window.playgrounds[0].ghost; return [it.frame, it.clouds.length, it.start, it.end]; }"
    first, drawn, start, end = page.evaluate(ghost)
    assert drawn == 1
    assert 0 <= start < end
    before = place(page, "grip")
    page.get_by_role("button", name="Move as recorded").click()
    page.wait_for_timeout(200)
    until(page, lambda: page.evaluate("() => window.playgrounds[0].replayed") is None)
    assert page.evaluate(ghost)[0] > first
    recorded = page.evaluate("""() => { const it = window.playgrounds[0];
        return it.ghost.grip(it.ready.grips[0], it.ghost.end, it.centre.clone()).toArray(); }""")
    wanted = np.linalg.norm(np.array(recorded) - before)
    assert wanted > 2e-3
    # what was sent last is drawn when its answer has come
    until(page, lambda: np.linalg.norm(place(page, "grip") - recorded) < 0.25 * wanted)
    page.wait_for_timeout(
        1000
    )  # every answer has come: no more is waited for, and the delay stays what it was
    delay = page.evaluate("() => window.playgrounds[0].delay")
    page.wait_for_timeout(500)
    assert page.evaluate("() => window.playgrounds[0].delay") == delay


def test_a_view_that_was_turned_is_set_back(served: Served, page: Page) -> None:
    enter(served, page)
    camera = "() => window.playgrounds[0].view.camera.position.toArray()"
    before = page.evaluate(camera)
    box = page.locator("[data-playground] canvas").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 30, box["y"] + box["height"] - 30)
    page.mouse.down()
    page.mouse.move(box["x"] + 160, box["y"] + box["height"] - 90, steps=5)
    page.mouse.up()
    assert page.evaluate(camera) != pytest.approx(before, rel=1e-3)
    page.get_by_role("button", name="Show all").click()
    assert page.evaluate(camera) == pytest.approx(before, rel=1e-6)
    page.mouse.move(box["x"] + 160, box["y"] + box["height"] - 90)
    page.mouse.wheel(0, -400)
    page.focus("[data-playground] canvas")
    page.keyboard.press("Home")
    assert page.evaluate(camera) == pytest.approx(before, rel=1e-6)


def test_what_is_recorded_comes_as_arrays_and_as_a_film(served: Served, page: Page, tmp_path: Path) -> None:
    enter(served, page)
    page.get_by_role("button", name="Record", exact=True).click()
    page.focus("[data-playground] canvas")
    page.keyboard.down("ArrowRight")
    page.wait_for_timeout(1500)
    page.keyboard.up("ArrowRight")
    page.get_by_role("button", name="Stop recording").click()
    for name, ending in (("npz", ".npz"), ("Film", ".webm")):
        with page.expect_download() as download:
            page.get_by_role("link", name=name).click()
        assert download.value.suggested_filename == f"{served.model}-{served.version}{ending}"
        download.value.save_as(tmp_path / f"kept{ending}")
    with np.load(tmp_path / "kept.npz") as arrays:
        times, vertices, controllers = (arrays[name] for name in ("times", "vertices", "controllers"))
    assert len(times) > 20
    assert vertices.shape[0] == controllers.shape[0] == len(times)
    assert (np.diff(times) > 0).all()
    assert controllers[-1, 0, 0] - controllers[0, 0, 0] > 0.01
    assert (tmp_path / "kept.webm").read_bytes()[:4] == b"\x1aE\xdf\xa3"


def test_the_twin_runs_live_beside_the_model_as_a_second_body(served: Served, page: Page) -> None:
    enter(served, page)
    page.get_by_label("Twin, live").check()
    words = page.locator("[data-twin]")
    expect(words).to_contain_text("its engine starts")
    expect(words).to_contain_text("× real time")
    until(page, lambda: int(page.get_attribute("[data-playground]", "data-twin-tick") or 0) > 20)
    before = place(page, "grip")
    page.focus("[data-playground] canvas")
    page.keyboard.down("PageUp")
    page.wait_for_timeout(1200)
    page.keyboard.up("PageUp")
    assert place(page, "grip")[2] - before[2] > 0.01
    state = """() => { const { twin, surface } = window.playgrounds[0]; const mean = (array) => { let sum = 0;
        for (let i = 2; i < array.length; i += 3) sum += 3 * array[i] / array.length; return sum; };
        return { twin: mean(twin.body.attribute.array), model: mean(surface.attribute.array),
        colours: [twin.body.mesh.material, surface.mesh.material].map((one) => one.color.getHexString()) }; }"""
    raised = page.evaluate(state)
    assert raised["colours"][0] != raised["colours"][1]

    def followed() -> bool:  # the twin goes up with its grips, at its own pace where the machine is busy
        now = page.evaluate(state)
        return bool(abs(now["twin"] - now["model"]) < 0.02)

    until(page, followed)
    expect(words).to_contain_text("mm from the model (mean)")
    assert float(page.get_attribute("[data-playground]", "data-twin-apart") or "nan") < 30.0
    page.get_by_label("Twin, live").uncheck()
    expect(words).to_have_text("")
    assert page.evaluate("() => window.playgrounds[0].twin.body") is None


def test_the_splat_of_the_scene_is_drawn_and_moves_with_the_model(served: Served, page: Page) -> None:
    """Ellipses in the colours of the splat, in the place of the surface; the switch gives the surface back."""
    model = tiny_model()[2]
    points = np.repeat(model.start_history[0], 20, axis=0)
    points += 0.003 * np.random.default_rng(0).standard_normal(points.shape)
    content = to_ply(gaussians_at_points(points, np.tile([0.1, 0.9, 0.2], (len(points), 1))))
    with served.client() as client:
        scene_id = client.get(f"/v1/models/{served.model}/versions/{served.version}").json()["scene_id"]
        files = {"bundle": ("splat.ply", content, "application/x-ply")}
        assert client.post(f"/v1/scenes/{scene_id}/pictures/splat.ply", files=files).status_code == 200
    enter(served, page)
    expect(page.get_by_label("as its splat")).to_be_checked()
    state = """() => { const { splat, surface, body } = window.playgrounds[0];
        const { centre } = splat.geometry.attributes;
        let mean = [0, 0, 0]; centre.array.forEach((value, i) => { mean[i % 3] += 3 * value / centre.array.length; });
        return { mean, count: splat.count, tint: [...splat.geometry.attributes.tint.array.slice(0, 3)],
        shown: [splat.mesh.visible, surface.mesh.visible, body.points.visible] }; }"""
    shown = page.evaluate(state)
    assert shown["shown"] == [True, False, False] and shown["count"] == len(points)
    assert shown["tint"] == pytest.approx([0.1, 0.9, 0.2], abs=0.01)
    until(page, lambda: bool(np.linalg.norm(page.evaluate(state)["mean"] - place(page, "centre")) < 0.01))
    assert green(page) > 1000
    before = page.evaluate(state)["mean"]
    page.focus("[data-playground] canvas")
    page.keyboard.down("PageUp")
    page.wait_for_timeout(1000)
    page.keyboard.up("PageUp")
    until(page, lambda: bool(page.evaluate(state)["mean"][2] - before[2] > 5e-3))
    page.get_by_label("as its splat").uncheck()
    assert page.evaluate(state)["shown"] == [False, True, False]
    until(page, lambda: green(page) == 0)


def green(page: Page) -> int:
    """Pixels of the view in the colour of the test's splat."""
    picture = page.locator("[data-playground] canvas").screenshot()
    colours = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)
    return int(((colours[..., 1] > 150) & (colours[..., 0] < 100) & (colours[..., 2] < 110)).sum())


def test_a_point_that_the_recording_lost_is_left_out(served: Served, page: Page) -> None:
    name, version = publish_tiny(served.database, served.stores.artifacts, name="lost-point", hidden=0)
    enter(dataclasses.replace(served, model=name, version=version), page)
    expect(page.get_by_label("Recording", exact=True)).to_be_checked()
    page.wait_for_timeout(500)  # some frames are drawn; the fixture asks for the errors of the page
