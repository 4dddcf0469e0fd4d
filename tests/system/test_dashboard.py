"""The dashboard as a person sees it: a real server, rows made through the storage, headless Chromium.

Every test's browser records console errors, violations of the content security policy and the address of
every request: at the end of each test there are none of the former two, and no request left this machine.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
from dashboard_browser import READY_MS, Visit
from dashboard_world import EPISODES, FRAMES, World, claim, complete, report
from playwright.sync_api import Page, expect

from physworld_schemas.fit import FitConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_storage import resources
from physworld_storage.jobs import jobs

pytestmark = pytest.mark.browser


def test_a_stranger_is_led_to_the_login_and_back(stranger: Visit, world: World) -> None:
    stranger.open(f"/scenes/{world.scene_id}")
    assert "/dashboard/login?next=" in stranger.page.url
    stranger.login(world.reader_token)
    expect(stranger.page).to_have_url(f"{stranger.base}/scenes/{world.scene_id}")
    cookie = next(item for item in stranger.page.context.cookies() if item["name"] == "physworld_session")
    assert cookie["httpOnly"]
    assert cookie["sameSite"] == "Strict"
    stranger.points_shown()
    stranger.page.get_by_role("button", name="Log out").click()
    stranger.page.wait_for_selector("#key")
    stranger.open("/")
    expect(stranger.page.locator("#key")).to_be_visible()


def test_a_wrong_key_is_refused(stranger: Visit) -> None:
    stranger.open("/login")
    stranger.page.fill("#key", "pw_wrong")
    stranger.page.click("button[type=submit]")
    expect(stranger.page.get_by_role("alert")).to_contain_text("not known")
    assert stranger.page.context.cookies() == []
    stranger.errors.clear()  # Chromium notes the 401 of the form itself


def test_the_job_list_moves_with_the_work(visit: Visit, world: World) -> None:
    assert world.running is not None
    row = visit.page.locator(f"#{world.running_id}")
    expect(row).to_contain_text("10 of 80 simulations")
    report(world, world.running, 40, 80, "simulations", "local stage")
    expect(row).to_contain_text("40 of 80 simulations")
    assert row.locator("progress").evaluate("bar => bar.value") == 0.5
    with world.database.session() as session:
        added = jobs.create_pipeline(session, PipelineCreate(scene_id=world.scene_id))
    stages = visit.page.locator(f"#{added.id} .stage")
    expect(stages).to_contain_text(["queued", "waiting", "waiting"])


def test_a_pipeline_shows_its_three_stages(visit: Visit, world: World) -> None:
    row = visit.page.locator(f"#{world.pipeline_id}")
    expect(row.locator(".stage")).to_have_count(3)
    row.locator(".title a").click()
    expect(visit.page.locator(".stage-cards .stage")).to_have_count(3)
    expect(visit.page.locator("h1")).to_contain_text("Pipeline of chain_swing")
    expect(visit.page.locator(".log li")).not_to_have_count(0)
    visit.page.get_by_role("link", name="chain_swing, version 1").first.click()
    expect(visit.page).to_have_url(f"{visit.base}/models/chain_swing/1")
    visit.points_shown()


def test_a_failed_job_says_why_with_its_numbers_and_a_hint(visit: Visit, world: World) -> None:
    visit.open(f"/jobs/{world.failed_id}")
    problem = visit.page.locator(".problem")
    expect(problem).to_contain_text("dt 1.0e-4 s exceeds the CFL limit 6.1e-5 s")
    expect(problem.locator(".hint")).to_contain_text("Lower the particle budget")


def test_a_job_is_cancelled_by_its_button_and_only_by_who_may_write(visit: Visit, world: World) -> None:
    with world.database.session() as session:
        job = jobs.create_fit(session, world.scene_id, FitConfig())
    visit.open(f"/jobs/{job.id}")
    visit.page.on("dialog", lambda dialog: dialog.accept())
    visit.page.get_by_role("button", name="Cancel").click()
    expect(visit.page.locator("h1 .badge")).to_have_text("cancelled")
    visit.page.get_by_role("button", name="Log out").click()
    visit.login(world.reader_token)
    visit.open(f"/jobs/{world.running_id}")
    expect(visit.page.locator("h1 .badge")).to_have_text("running")
    expect(visit.page.get_by_role("button", name="Cancel")).to_have_count(0)


def test_the_scene_is_drawn_and_the_slider_moves_it(visit: Visit, world: World, tmp_path: Path) -> None:
    visit.open(f"/scenes/{world.scene_id}")
    visit.points_shown()
    canvas = visit.page.locator("figure canvas")
    first = canvas.screenshot(path=tmp_path / "first.png")
    assert coloured_pixels(visit.page, first) > 200
    slider = visit.page.locator("[data-slider]")
    assert slider.get_attribute("max") == str(FRAMES - 1)
    slider.fill("70")
    expect(visit.page.locator("[data-clock]")).to_contain_text(f"frame 71 of {FRAMES} · held out")
    second = canvas.screenshot(path=tmp_path / "second.png")
    assert second != first
    assert coloured_pixels(visit.page, second) > 200
    for box in visit.page.locator("[data-legend] input").all():
        box.uncheck()
    assert coloured_pixels(visit.page, canvas.screenshot()) < 20


def test_a_scene_without_a_twin_says_what_to_do_or_where_one_is_being_made(
    visit: Visit, world: World
) -> None:
    with world.database.reading() as session:
        scenes = {scene.name: scene.id for scene in resources.list_scenes(session).data}
    visit.open(f"/scenes/{scenes['chain_failed']}")
    calibrate = visit.page.locator(".empty").get_by_role("link", name="Calibrate")
    expect(calibrate).to_have_attribute("href", f"/dashboard/start/fit?scene_id={scenes['chain_failed']}")
    visit.points_shown()
    visit.open(f"/scenes/{scenes['chain_running']}")
    visit.points_shown()
    visit.page.get_by_role("link", name="follow its job").click()
    expect(visit.page).to_have_url(f"{visit.base}/jobs/{world.running_id}")


def test_long_lists_come_in_pages(visit: Visit, world: World) -> None:
    with world.database.session() as session:
        made = [jobs.create_fit(session, world.scene_id, FitConfig()).id for _ in range(30)]
        for job_id in made:
            jobs.cancel_job(session, job_id)
    visit.open("/?state=cancelled")
    seen = visit.page.locator(".job").evaluate_all("rows => rows.map(row => row.id)")
    visit.page.get_by_role("link", name="Older").click()
    visit.page.wait_for_selector("text=Newest")
    seen += visit.page.locator(".job").evaluate_all("rows => rows.map(row => row.id)")
    assert set(made) <= set(seen)
    assert len(seen) == len(set(seen))


def test_the_scene_plays(visit: Visit, world: World) -> None:
    visit.open(f"/scenes/{world.scene_id}")
    visit.points_shown()
    visit.page.select_option("[data-speed]", "2")
    visit.page.get_by_role("button", name="Play").click()
    viewer = visit.page.locator("figure.viewer")
    expect(viewer).to_have_attribute("data-frame", str(FRAMES - 1), timeout=READY_MS)
    expect(visit.page.get_by_role("button", name="Play")).to_be_visible()


def test_the_error_curve_and_the_parameters_of_the_twin_are_there(visit: Visit, world: World) -> None:
    visit.open(f"/scenes/{world.scene_id}")
    visit.page.wait_for_selector("[data-curve][data-ready]")
    legend = visit.page.locator(".curve .legend").first
    for name in ("twin", "static", "rigid follow", "constant velocity"):
        expect(legend).to_contain_text(name)
    table = visit.page.locator("section", has_text="Calibrated parameters").last
    expect(table).to_contain_text("171,000 to 198,000")
    expect(table).to_contain_text("no, held at its prior")
    told = visit.page.locator(".curve figure[data-series]").get_attribute("data-series")
    assert told is not None
    with world.database.reading() as session:
        fit = resources.list_fits(session, scene_id=world.scene_id, state="ready").data[0]
    assert fit.parameters["youngs_modulus"].value == 1.84e5
    twin = next(item["values"] for item in json.loads(told) if item["label"] == "twin")
    assert len(twin) == FRAMES
    assert twin[-1] == pytest.approx(20 * (1 + 0.4**2 + 0.3**2) ** 0.5, rel=1e-4)  # the drift of 20 mm put in
    visit.points_shown()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_maps_of_residuals_are_drawn_follow_the_view_and_seek_in_it(
    visit: Visit, world: World, scheme: str
) -> None:
    visit.page.emulate_media(color_scheme=scheme)
    for path, maps in ((f"/scenes/{world.scene_id}", 1), ("/models/chain_swing/1", 2)):
        visit.open(path)
        visit.points_shown()
        part = visit.page.locator('[data-curve*="/residuals"][data-ready]')
        expect(part.locator("figure")).to_have_count(maps)
        expect(part.locator(".legend")).to_contain_text("not seen")
        chart = part.locator("svg.chart.wide").first
        chart.scroll_into_view_if_needed()
        assert coloured_pixels(visit.page, chart.screenshot()) > 2000, "the policy lets the picture in"
        box = chart.bounding_box()
        assert box is not None
        chart.click(position={"x": 0.9 * box["width"], "y": 0.5 * box["height"]})
        expect(visit.page.locator("[data-clock]")).to_contain_text("held out")
        expect(chart.locator(".playhead")).to_have_css("display", "inline")


def test_a_dataset_shows_its_episodes_and_one_of_them_in_3d(visit: Visit, world: World) -> None:
    visit.open(f"/datasets/{world.dataset_id}")
    visit.points_shown()
    expect(visit.page.locator("#episodes tbody tr:has(a)")).to_have_count(EPISODES)
    visit.page.locator("#episodes tbody td:first-child a").last.click()
    visit.points_shown()
    expect(visit.page.locator("figure canvas")).to_have_attribute(
        "aria-label", "Particles of episode 2 in 3D"
    )


def test_a_dataset_shows_what_it_covers_and_what_was_rejected(
    visit: Visit, world: World, tmp_path: Path
) -> None:
    visit.open(f"/datasets/{world.dataset_id}")
    picture = visit.page.locator("#coverage img")
    expect(picture).to_be_visible()
    assert picture.evaluate("image => image.decode().then(() => image.naturalWidth)") > 400
    panel = visit.page.locator("#coverage")
    expect(panel).to_contain_text("1 try was rejected (1 UnstableSimulation)")
    expect(panel.locator("tbody tr")).to_contain_text("t = 0.31 s: <b>not</b> finite")
    with visit.page.expect_download() as download:
        panel.get_by_role("link", name="card.json").click()
    download.value.save_as(tmp_path / "card.json")
    card = json.loads((tmp_path / "card.json").read_text())
    assert card["episodes"] == EPISODES and card["rejections"]["by_motion"]["twist"] == {
        "rejected": 1,
        "tries": 1,
    }


def test_a_model_shows_its_card_and_gives_its_files(visit: Visit, world: World, tmp_path: Path) -> None:
    assert world.model_file is not None
    visit.open("/models/chain_swing/1")
    visit.points_shown()
    visit.page.wait_for_selector("[data-curve][data-ready]")
    best = visit.page.locator("table.held-out td.best").first
    expect(best).to_have_text("5.00")
    expect(visit.page.locator("main")).to_contain_text("640 steps/s")
    with visit.page.expect_download() as download:
        visit.page.get_by_role("link", name="model.safetensors").click()
    assert download.value.suggested_filename == "model.safetensors"
    download.value.save_as(tmp_path / "model")
    data = (tmp_path / "model").read_bytes()
    assert data == world.model_bytes
    assert hashlib.sha256(data).hexdigest() == world.model_file.sha256


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_page_is_wider_than_a_phone(visit: Visit, world: World, scheme: str) -> None:
    visit.page.emulate_media(color_scheme=scheme)
    visit.page.set_viewport_size({"width": 400, "height": 860})
    for path in (
        "/",
        f"/jobs/{world.pipeline_id}",
        "/scenes",
        f"/scenes/{world.scene_id}",
        "/datasets",
        f"/datasets/{world.dataset_id}",
        "/models",
        "/models/chain_swing",
        "/models/chain_swing/1",
    ):
        visit.open(path)
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= 400, path


def test_what_does_not_exist_has_a_friendly_page(visit: Visit) -> None:
    for path in (
        "/nothing",
        "/scenes/scn_unknown",
        "/jobs/job_unknown",
        "/models/unknown/1",
        "/models/chain_swing/x",
    ):
        visit.open(path)
        expect(visit.page.locator("main")).to_contain_text("This page does not exist")
    visit.errors.clear()  # Chromium notes each 404 itself


def test_a_finished_job_ends_its_stream(visit: Visit, world: World) -> None:
    with world.database.session() as session:
        job = jobs.create_fit(session, world.scene_id, FitConfig())
    visit.open(f"/jobs/{job.id}")
    expect(visit.page.locator("h1 .badge")).to_have_text("queued")
    lease = claim(world, job.id)
    expect(visit.page.locator("h1 .badge")).to_have_text("running")
    complete(world, lease, {"parameters": {}, "metrics": {}, "artifacts": []})
    expect(visit.page.locator("h1 .badge")).to_have_text("succeeded")


def coloured_pixels(page: Page, screenshot: bytes) -> int:
    """Pixels of a PNG with a clear hue: points, not background, grid or text. The browser decodes it."""
    return page.evaluate(
        """async (bytes) => {
          const image = await createImageBitmap(new Blob([new Uint8Array(bytes)], { type: "image/png" }));
          const canvas = new OffscreenCanvas(image.width, image.height);
          const context = canvas.getContext("2d");
          context.drawImage(image, 0, 0);
          const data = context.getImageData(0, 40, image.width, image.height - 40).data;
          let count = 0;
          for (let i = 0; i < data.length; i += 4) {
            const channels = [data[i], data[i + 1], data[i + 2]];
            if (Math.max(...channels) - Math.min(...channels) > 60) count += 1;
          }
          return count;
        }""",
        list(screenshot),
    )
