"""The whole life of a model in the browser, from an empty folder and without the command line: bring a recording in,
make a model of it, watch that, trace, make a second version, compare, play, keep files, delete everything.

And from a table of markers, or from a depth camera's pictures: what the page guesses or shows of them, what a person
has to say, the scene, the published model.

The service is the embedded one in processes of its own; the scenes and every budget are small.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import marker_files
import numpy as np
import pytest
from dashboard_browser import WATCH_POLICY, Visit
from playwright.sync_api import Browser, expect
from service_process import ServiceProcess
from test_dashboard_first import fill as boxed
from test_dashboard_first import packed
from tiny_scene import tiny_scene
from tracking_pictured import BOTTOM, LEFT, RIGHT, TOP, write

from physworld_scenes.bundle import canonical_archive, read_bundle

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(900)]
JOB_MS = 240_000
FRAMES = 24
SAMPLE = Path(__file__).parents[2] / "sample" / "soft_beam"
SMALL = {
    "fit__max_simulations": "20",
    "fit__particle_budget": "60",
    "fit__numerics": "off",
    "dataset__episodes": "3",
    "dataset__frames": str(FRAMES),
    "training__hidden": "8",
    "training__message_passing_steps": "2",
    "training__look_ahead": "4",
    "training__vertices": "20",
    "training__steps": "20",
    "training__fine_tune_steps": "0",
    "training__formats": "off",
}
"""Fields of the smallest pipeline that makes a model."""


@pytest.fixture
def life(browser: Browser, tmp_path: Path) -> Iterator[Visit]:
    """A tab on a service that has just begun on an empty folder."""
    with ServiceProcess(tmp_path / "data", "--workers", "2") as service:
        state = service.start().state()
        context = browser.new_context(viewport={"width": 1280, "height": 900}, accept_downloads=True)
        context.add_init_script(WATCH_POLICY)
        visit = Visit(context.new_page(), f"{state['api_url']}/dashboard")
        visit.page.on("pageerror", lambda error: visit.errors.append(str(error)))
        visit.page.on("dialog", lambda dialog: dialog.accept())
        visit.open("/")
        visit.login(Path(state["api_key_file"]).read_text().strip())
        yield visit
        assert visit.page.evaluate("window.violations") == []
        assert visit.errors == []
        context.close()


def fill(visit: Visit, **values: str) -> None:
    """Set fields of a form by their names, with the groups open, and start."""
    for group in visit.page.locator("details.panel").all():
        group.evaluate("group => { group.open = true; }")
    for name, value in values.items():
        field = visit.page.locator(f'[name="{name.replace("__", ".")}"]')
        tag = field.first.evaluate("field => field.type")
        if tag == "checkbox":
            for box in field.all():
                box.set_checked(value == "on")
        elif tag.startswith("select"):
            field.select_option(value)
        else:
            field.fill(value)
    visit.page.get_by_role("button", name="Start").click()
    visit.page.wait_for_url(re.compile(r"/jobs/job_"))


def done(visit: Visit) -> None:
    """Wait on a job's page until it says that it has succeeded."""
    expect(visit.page.locator("h1 .badge")).to_have_text(re.compile("succeeded|failed"), timeout=JOB_MS)
    expect(visit.page.locator("h1 .badge")).to_have_text("succeeded")


def delete(visit: Visit, path: str, kind: str) -> None:
    """Delete the object that the page shows; what stays is another page."""
    visit.open(path)
    visit.page.locator(f'form[action*="{kind}"] button', has_text="Delete").click()
    visit.page.wait_for_url(re.compile(r"/(models/\w+|models|datasets|traces|fits|scenes)$"))


def test_from_an_empty_folder_to_a_model_that_is_played_with_and_back(life: Visit, tmp_path: Path) -> None:
    visit, page = life, life.page
    expect(page.locator("main")).to_contain_text("No job yet")  # an empty state that does the first step
    expect(page.get_by_role("button", name="Take the sample scene")).to_be_visible()

    # upload
    recording = tmp_path / "bar.zip"
    recording.write_bytes(canonical_archive(tiny_scene(FRAMES)))
    page.get_by_role("link", name="Upload a recording").click()
    page.set_input_files("#bundle", recording)
    page.get_by_role("button", name="Upload").click()
    page.wait_for_url(re.compile(r"/scenes/scn_"))
    expect(page.locator("h1")).to_contain_text("tiny bar")
    visit.points_shown()
    scene = page.url.rsplit("/", 1)[1].split("?")[0]

    # run and watch
    page.get_by_role("link", name="Make a world model").click()
    fill(visit, model_name="bar", **SMALL)
    expect(page.locator(".stage").first).to_contain_text("Fit")
    expect(page.locator("progress").first).to_be_visible()
    done(visit)
    page.get_by_role("link", name=re.compile("bar, version 1")).first.click()
    expect(page.locator("h1")).to_contain_text("bar · version 1")
    expect(page.locator("table.held-out")).to_contain_text("World model")
    places = page.locator("svg.lineage a").evaluate_all(
        "links => links.map(link => [link.classList[0], link.getAttribute('href')])"
    )
    assert [kind for kind, _ in places] == ["scene", "fit", "dataset", "model"]
    made = {kind: address.removeprefix("/dashboard") for kind, address in places}

    # trace
    visit.open(f"/start/trace?scene_id={scene}")
    fill(
        visit,
        config__time_limit_s="20",
        fit__max_simulations="20",
        fit__particle_budget="60",
        config__confirmed="1",
    )
    done(visit)
    page.get_by_role("link", name=re.compile("trace …")).first.click()
    expect(page.locator("main")).to_contain_text("On the held-out frames")
    trace = page.url.removeprefix(visit.base)

    # a second version, and both side by side
    visit.open(f"/start/training?dataset_id={made['dataset'].rsplit('/', 1)[1]}&name=bar")
    small = {"hidden": "8", "message_passing_steps": "2", "look_ahead": "4", "vertices": "20", "steps": "30"}
    small |= {"fine_tune_steps": "0", "formats": "off"}
    fill(visit, **{f"config__{name}": value for name, value in small.items()})
    done(visit)
    visit.open("/models/bar")
    page.get_by_role("link", name="Compare versions").click()
    expect(page.locator("main")).to_contain_text("Error on the held-out frames")
    expect(page.locator(".curve svg").first).to_be_visible()

    # play
    visit.open("/models/bar/1/playground")
    page.wait_for_selector("[data-playground][data-ready][data-accompanied][data-frames]")
    page.get_by_role("button", name="Record", exact=True).click()
    page.focus("[data-playground] canvas")
    page.keyboard.down("ArrowRight")
    page.wait_for_timeout(1500)
    page.keyboard.up("ArrowRight")
    page.get_by_role("button", name="Stop recording").click()

    # keep files
    with page.expect_download() as download:
        page.get_by_role("link", name="npz").click()
    download.value.save_as(tmp_path / "played.npz")
    with np.load(tmp_path / "played.npz") as arrays:
        assert np.ptp(arrays["controllers"][:, 0, 0]) > 1e-3
    visit.open("/models/bar/1")
    with page.expect_download() as download:
        page.get_by_role("link", name="model.safetensors").click()
    download.value.save_as(tmp_path / "model.safetensors")
    assert (tmp_path / "model.safetensors").stat().st_size > 1000

    # delete, from the end to the beginning
    for path in ("/models/bar/2", "/models/bar/1"):
        delete(visit, path, path)
    delete(visit, made["dataset"], "/delete/dataset/")
    delete(visit, trace, "/delete/trace/")
    visit.open("/fits")
    fits = page.locator('tbody a[href*="/fits/"]').evaluate_all(
        "links => links.map(link => link.getAttribute('href'))"
    )
    for address in fits:
        delete(visit, address.removeprefix("/dashboard"), "/delete/fit/")
    delete(visit, f"/scenes/{scene}", "/delete/scene/")
    visit.open("/scenes")
    expect(page.locator("main")).to_contain_text("No scene yet")


def table_of_the_sample(frames: int) -> bytes:
    """The first frames of the sample scene as a table of markers: columns in millimetres, y up."""
    scene = read_bundle(SAMPLE)
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1))
    grip, points = (
        scene.controllers[:frames],
        np.where(scene.visible[..., None], scene.points, np.nan)[:frames],
    )
    motion = marker_files.Motion(scene.times[:frames], points, grip, grip.mean(axis=1), turns)
    return marker_files.columns(motion, up="y", unit="mm")


def test_from_a_table_of_markers_to_a_published_model(life: Visit, tmp_path: Path) -> None:
    visit, page = life, life.page
    table = tmp_path / "soft beam.csv"
    table.write_bytes(table_of_the_sample(2 * FRAMES))
    visit.open("/scenes")
    page.set_input_files("#bundle", table)
    page.get_by_role("button", name="Upload").click()

    # what was guessed, and nothing stored
    told = page.locator("[data-told]")
    expect(told).to_contain_text("nothing is stored yet")
    expect(told.get_by_role("row", name=re.compile("^unit mm"))).to_be_visible()
    expect(told.get_by_role("row", name=re.compile("^gripper"))).to_contain_text("grip1")

    # what no table tells, and what was guessed wrongly
    page.locator("select[data-option=kind]").select_option("beam")
    page.get_by_label("Mass [kg]").fill("0.2304")
    page.locator("select[data-option=up]").select_option("y")
    page.get_by_role("button", name="Look again").click()
    expect(told.get_by_role("row", name=re.compile("^up "))).to_contain_text("given")
    page.get_by_role("button", name="Store the scene").click()
    page.wait_for_url(re.compile(r"/scenes/scn_"))
    expect(page.locator("h1")).to_contain_text("soft beam")
    expect(page.locator("main")).to_contain_text("80 tracked, 12 controllers")
    visit.points_shown()

    published(visit, "beam")


def test_from_pictures_to_a_published_model(life: Visit, tmp_path: Path) -> None:
    visit, page = life, life.page
    write(tmp_path / "plate", FRAMES)
    archive = packed(tmp_path / "plate", tmp_path / "plate.zip")
    visit.open("/trackings")
    page.set_input_files("#pictures", archive)
    page.get_by_role("button", name="Look").click()
    expect(page.locator("[data-first]")).to_have_attribute("data-ready", "true")

    # where the plate is, what moves it and what that holds; what no picture tells
    middle = (TOP + BOTTOM) // 2
    boxed(visit, "Box of the object", (LEFT - 8, TOP - 8, RIGHT + 8, BOTTOM + 8))
    boxed(visit, "Patch of the gripper", (LEFT + 2, middle - 12, LEFT + 26, middle + 12))
    boxed(visit, "Box of what is held", (LEFT, TOP, LEFT + 15, BOTTOM))
    page.get_by_label("What moves the object").select_option("patch")
    page.locator("select[data-option=up]").select_option("-y")
    page.locator("select[data-option=kind]").select_option("sheet")
    page.get_by_label("Mass [kg]").fill("0.05")
    page.get_by_label("Thickness of a sheet [m]").fill("0.004")
    page.get_by_role("button", name="Make the scene").click()
    page.wait_for_url(re.compile(r"/jobs/job_"))
    done(visit)
    page.get_by_role("link", name=re.compile("plate")).first.click()
    page.wait_for_url(re.compile(r"/scenes/scn_"))
    expect(page.locator("main")).to_contain_text("8 controllers")
    visit.points_shown()
    published(visit, "plate")


def published(visit: Visit, name: str) -> None:
    """The pipeline of the scene that the page shows, with small settings, up to the page of the published version."""
    page = visit.page
    page.get_by_role("link", name="Make a world model").click()
    fill(visit, model_name=name, **SMALL)
    done(visit)
    page.get_by_role("link", name=re.compile(f"{name}, version 1")).first.click()
    expect(page.locator("h1")).to_contain_text(f"{name} · version 1")
    expect(page.locator("h1 .badge").first).to_have_text("ready")
    expect(page.locator("table.held-out")).to_contain_text("World model")
    visit.points_shown()
    places = page.locator("svg.lineage a").evaluate_all("links => links.map(link => link.classList[0])")
    assert places == ["scene", "fit", "dataset", "model"]
