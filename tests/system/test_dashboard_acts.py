"""What people do on the dashboard: bring a recording in, start work by a form, start it again, label, delete.

The server is real, the uploads are read by the process that reads them in production, the browser is Chromium.
"""

from __future__ import annotations

import io
import re
import zipfile
from pathlib import Path

import marker_files
import numpy as np
import pytest
import robot_logs
import tracking_pictured
from dashboard_browser import Visit
from dashboard_world import World, add_scene, chain_recording
from playwright.sync_api import expect
from test_dashboard_accessible import violations

from physworld.scene import Scene
from physworld_storage import registry, resources
from physworld_storage.errors import NotFound
from physworld_storage.jobs import jobs
from physworld_storage.tables import ShardRow

pytestmark = pytest.mark.browser
SAMPLE = Path(__file__).parents[2] / "sample" / "soft_beam"
DROP = """async ([form, files]) => {
  const entry = (name, bytes) => ({ name, isFile: true,
    file: (done) => done(new File([new Uint8Array(bytes)], name)) });
  const listed = files.map(([name, bytes]) => entry(name, bytes));
  const folder = { name: "dropped", isDirectory: true,
    createReader: () => ({ readEntries: (done) => done(listed.splice(0)) }) };
  const event = new Event("drop", { cancelable: true });
  event.dataTransfer = { items: [{ webkitGetAsEntry: () => folder }], files: [] };
  form.dispatchEvent(event);
}"""


def test_the_sample_scene_comes_in_by_one_click_and_a_second_click_finds_it(
    visit: Visit, world: World
) -> None:
    with world.database.session() as session:
        for scene in resources.list_scenes(session).data:
            assert scene.name != "soft_beam"
    visit.open("/scenes")
    visit.page.evaluate(
        """() => { const form = document.createElement("form"); form.method = "post";
        form.action = "/dashboard/scenes/sample"; document.body.append(form); form.submit(); }"""
    )
    visit.page.wait_for_url(re.compile(r"/scenes/scn_"))
    expect(visit.page.locator("h1")).to_contain_text("soft_beam")
    visit.points_shown()


def test_a_folder_that_is_dropped_becomes_a_scene(visit: Visit, world: World) -> None:
    visit.open("/scenes")
    files = [[name, list((SAMPLE / name).read_bytes())] for name in ("scene.json", "scene.npz")]
    form = visit.page.locator("[data-upload]").element_handle()
    visit.page.evaluate(DROP, [form, files])
    visit.page.wait_for_url(re.compile(r"/scenes/scn_"))
    expect(visit.page.locator("h1")).to_contain_text("soft_beam")


def test_a_folder_without_a_scene_says_what_is_missing_and_sends_nothing(visit: Visit) -> None:
    visit.open("/scenes")
    form = visit.page.locator("[data-upload]").element_handle()
    visit.page.evaluate(DROP, [form, [["scene.json", [123, 125]]]])
    expect(visit.page.locator("[data-told]")).to_contain_text(
        "lacks scene.json or scene.npz; it holds scene.json"
    )
    assert not [url for url in visit.requests if url.endswith("/scenes") and "POST" in url]


def test_a_file_that_is_no_recording_is_refused_where_it_was_given(visit: Visit, tmp_path: Path) -> None:
    wrong = tmp_path / "notes.txt"
    wrong.write_text("no recording")
    visit.open("/scenes")
    expect(visit.page.get_by_role("progressbar", name="Upload")).to_be_hidden()
    visit.page.set_input_files("#bundle", wrong)
    visit.page.get_by_role("button", name="Upload").click()
    expect(visit.page.locator("[data-told] li").first).to_contain_text("notes.txt: is neither")
    visit.errors.clear()  # Chromium notes the 422 itself


def test_a_table_of_markers_is_looked_at_and_stored_when_that_is_confirmed(
    visit: Visit, world: World, tmp_path: Path
) -> None:
    table = tmp_path / "hanging cloth.csv"
    table.write_bytes(marker_files.columns(marker_files.made(frames=60), up="y", unit="mm"))
    visit.open("/scenes")
    visit.page.set_input_files("#bundle", table)
    visit.page.get_by_role("button", name="Upload").click()
    told = visit.page.locator("[data-told]")
    expect(told).to_contain_text("nothing is stored yet")
    hangs = "the body hangs from its gripper along it"
    expect(told.get_by_role("row", name=re.compile("^up "))).to_contain_text(hangs)
    expect(told.locator("li", has_text="up is guessed to be y")).to_be_visible()
    visit.page.locator("select[data-option=kind]").select_option("sheet")
    visit.page.get_by_label("Mass [kg]").fill("0.08")
    visit.page.locator("select[data-option=up]").select_option("y")
    visit.page.get_by_role("button", name="Look again").click()
    expect(told.get_by_role("row", name=re.compile("^up "))).to_contain_text("given")
    visit.page.get_by_role("button", name="Store the scene").click()
    visit.page.wait_for_url(re.compile(r"/scenes/scn_"))
    with world.database.session() as session:
        scene = next(one for one in resources.list_scenes(session).data if one.name == "hanging cloth")
        assert (scene.kind, scene.points, scene.controllers) == ("sheet", 16, 4)


def test_a_pipeline_is_started_by_its_form_with_other_settings(visit: Visit, world: World) -> None:
    visit.open(f"/scenes/{world.scene_id}")
    visit.page.get_by_role("link", name="Make a world model").click()
    expect(visit.page.locator("#scene_id")).to_have_value(world.scene_id)
    visit.page.locator("summary", has_text="Dataset").click()
    episodes = visit.page.get_by_label("Episodes", exact=True)
    expect(episodes).to_have_value("300")
    expect(episodes).to_have_attribute("max", "20000")
    episodes.fill("12")
    visit.page.get_by_role("button", name="Start").click()
    expect(visit.page.locator("h1")).to_contain_text("Pipeline of chain_swing")
    job_id = visit.page.url.rpartition("/")[2]
    with world.database.reading() as session:
        job = jobs.get_job(session, job_id)
    assert job.config["dataset"]["episodes"] == 12
    assert job.config["fit"]["particle_budget"] == 2000
    with world.database.session() as session:
        jobs.cancel_job(session, job_id)


def test_a_value_beyond_its_bounds_is_said_at_its_field_and_starts_nothing(
    visit: Visit, world: World
) -> None:
    with world.database.reading() as session:
        before = len(jobs.list_jobs(session, limit=200).data)
    visit.open(f"/start/fit?scene_id={world.scene_id}")
    visit.page.locator("summary").first.click()
    visit.page.get_by_label("Particle budget").fill("7")
    visit.page.get_by_role("button", name="Start").click()
    expect(visit.page.locator(".at-fault .fault")).to_have_text("Input should be greater than or equal to 50")
    expect(visit.page.get_by_label("Particle budget")).to_have_value("7")
    with world.database.reading() as session:
        assert len(jobs.list_jobs(session, limit=200).data) == before
    visit.errors.clear()  # Chromium notes the 422 itself


def test_a_job_is_started_again_with_one_setting_changed(visit: Visit, world: World) -> None:
    visit.open(f"/jobs/{world.failed_id}")
    visit.page.get_by_role("link", name="Again with other settings").click()
    visit.page.locator("summary").first.click()
    visit.page.get_by_label("Particle budget").fill("500")
    visit.page.get_by_role("button", name="Start").click()
    expect(visit.page.locator("h1")).to_contain_text("Fit of chain_failed")
    job_id = visit.page.url.rpartition("/")[2]
    with world.database.session() as session:
        assert jobs.get_job(session, job_id).config["particle_budget"] == 500
        jobs.cancel_job(session, job_id)


def test_a_rollout_and_a_plan_have_pages_with_a_player_and_their_files(visit: Visit, world: World) -> None:
    for path, name in ((f"/rollouts/{world.rollout_id}", "rollout"), (f"/plans/{world.plan_id}", "plan")):
        visit.open(f"/{name}s")
        visit.page.locator("tbody a").first.click()
        expect(visit.page).to_have_url(f"{visit.base}{path}")
        visit.points_shown()
        expect(visit.page.get_by_role("link", name=f"{name}.npz")).to_be_visible()


def test_a_version_is_labelled_and_takes_an_alias(visit: Visit, world: World) -> None:
    visit.open("/models/chain_swing/1")
    visit.page.get_by_label("Description").fill("the one for the demo")
    visit.page.get_by_role("button", name="Keep").click()
    expect(visit.page.locator(".sub").first).to_contain_text("the one for the demo")
    visit.page.get_by_label("Alias").fill("champion")
    visit.page.get_by_role("button", name="Point it here").click()
    expect(visit.page.locator("h1")).to_contain_text("champion")
    with world.database.session() as session:
        assert registry.get_version(session, "chain_swing", "champion").description == "the one for the demo"
        registry.delete_alias(session, "chain_swing", "champion")


def test_what_is_used_is_not_deleted_and_says_by_what(visit: Visit, world: World) -> None:
    visit.page.on("dialog", lambda dialog: dialog.accept())
    visit.open(f"/datasets/{world.dataset_id}")
    visit.page.get_by_role("button", name="Delete").click()
    expect(visit.page.locator("main")).to_contain_text("was used by model chain_swing; delete that first")
    visit.errors.clear()  # Chromium notes the 409 itself


def test_a_scene_that_nothing_uses_is_deleted(visit: Visit, world: World) -> None:
    recording = chain_recording()
    scene_id = add_scene(world, Scene(**{**vars(recording), "name": "short_lived"}))
    visit.page.on("dialog", lambda dialog: dialog.accept())
    visit.open(f"/scenes/{scene_id}")
    visit.page.get_by_role("button", name="Delete").click()
    expect(visit.page).to_have_url(f"{visit.base}/scenes")
    with world.database.reading() as session, pytest.raises(NotFound):
        resources.get_scene(session, scene_id)


def test_an_administrator_makes_a_key_whose_token_is_shown_once(stranger: Visit, world: World) -> None:
    stranger.open("/")
    stranger.login(world.admin_token)
    stranger.open("/keys")
    stranger.page.get_by_label("Name", exact=True).fill("robot-1")
    stranger.page.get_by_role("button", name="Make it").click()
    token = stranger.page.locator("[data-token]").inner_text()
    assert token.startswith("pw_")
    stranger.open("/keys")
    expect(stranger.page.locator("[data-token]")).to_have_count(0)
    expect(stranger.page.locator("tbody")).to_contain_text("robot-1")


def test_a_reader_is_shown_no_button_and_refused_the_forms(stranger: Visit, world: World) -> None:
    stranger.open("/")
    stranger.login(world.reader_token)
    stranger.open(f"/scenes/{world.scene_id}")
    expect(stranger.page.get_by_role("link", name="Make a world model")).to_have_count(0)
    stranger.open("/start/pipeline")
    expect(stranger.page.locator("h1")).to_have_text("This key may not do that")
    stranger.open("/keys")
    expect(stranger.page.locator("h1")).to_have_text("This key may not do that")
    stranger.errors.clear()  # Chromium notes each 403 itself


def test_a_page_that_does_not_exist_has_the_navigation(visit: Visit) -> None:
    visit.open("/nothing")
    expect(visit.page.locator("h1")).to_have_text("This page does not exist")
    visit.page.locator(".top nav").get_by_role("link", name="Models").click()
    expect(visit.page.locator("h1")).to_have_text("Models")
    visit.errors.clear()  # Chromium notes the 404 itself


def test_pictures_are_looked_at_a_box_is_drawn_and_a_job_follows_the_object(
    visit: Visit, world: World, tmp_path: Path
) -> None:
    folder, archive = tmp_path / "plate", tmp_path / "plate.zip"
    tracking_pictured.write(folder)
    with zipfile.ZipFile(archive, "w") as packed:
        for path in sorted(folder.rglob("*.*")):
            packed.write(path, path.relative_to(tmp_path).as_posix())
    (tmp_path / "robot.csv").write_text("t,x,y,z\n0,0,0,0\n1,0,0,0.1\n")
    arm = tmp_path / "arm"
    robot_logs.lerobot_info(arm, list(robot_logs.EULER))
    robot_logs.lerobot_file(arm / "episode_000004.parquet", {4: (np.arange(2.0), np.zeros((2, 7)))})
    visit.open("/scenes")
    visit.page.get_by_role("link", name="Make a scene of them").click()
    visit.page.set_input_files("#pictures", archive)
    visit.page.get_by_role("button", name="Look").click()
    expect(visit.page.locator("[data-told]")).to_contain_text("plate.zip: 1 camera, 12 pictures each")
    canvas = visit.page.get_by_role("img", name="First picture of the camera, with the boxes")
    expect(canvas).to_have_attribute("width", "160")
    for scheme, width in (("dark", 360), ("light", 1280)):
        visit.page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        visit.page.set_viewport_size({"width": width, "height": 900})
        assert violations(visit) == []
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= width
    canvas.scroll_into_view_if_needed()
    area = canvas.bounding_box()
    assert area is not None
    scale = area["width"] / tracking_pictured.WIDTH
    mouse = visit.page.mouse

    def at(column: int, row: int) -> tuple[float, float]:
        return area["x"] + column * scale, area["y"] + row * scale

    mouse.move(*at(42, 32))
    mouse.down()
    mouse.move(*at(118, 88), steps=4)
    mouse.up()
    box = [int(one.input_value()) for one in visit.page.locator("[data-box=object] [data-corner]").all()]
    assert all(abs(mine - meant) <= 1 for mine, meant in zip(box, (42, 32, 118, 88), strict=True)), box
    visit.page.get_by_role("radio", name="draw or click it by mouse").check()
    canvas.click(position={"x": 60 * scale, "y": 60 * scale})
    expect(visit.page.get_by_label("What moves the object")).to_have_value("patch")
    held = visit.page.get_by_role("group", name="Box of what is held")
    for corner, value in zip(("Left", "Top", "Right", "Bottom"), (50, 40, 65, 80), strict=True):
        held.get_by_label(corner).fill(str(value))  # as somebody does who has no mouse
    visit.page.locator("select[data-option=kind]").select_option("sheet")
    visit.page.get_by_label("Mass [kg]").fill("0.05")
    visit.page.get_by_role("button", name="Make the scene").click()
    visit.page.wait_for_url(re.compile(r"/jobs/job_"))
    expect(visit.page.locator("h1")).to_contain_text("Tracking of plate.zip")
    with world.database.session() as session:
        job = jobs.get_job(session, visit.page.url.rpartition("/")[2])
        jobs.cancel_job(session, job.id)
    assert job.config["boxes"] == {"0": box} and job.config["body"] == {"mass_kg": 0.05}
    patch = job.config["gripper"]["patch"]
    assert [patch[2] - patch[0], patch[3] - patch[1]] == [40, 40] and abs(patch[0] - 40) <= 1
    assert job.config["gripper"]["held_px"] == [50, 40, 65, 80]

    visit.open("/trackings")
    visit.page.set_input_files("#folder", folder)
    visit.page.get_by_role("button", name="Look").click()
    expect(visit.page.locator("[data-told]")).to_contain_text("plate.zip: 1 camera")
    for corner, value in zip(("Left", "Top", "Right", "Bottom"), (42, 32, 118, 88), strict=True):
        visit.page.get_by_role("group", name="Box of the object").get_by_label(corner).fill(str(value))
    visit.page.get_by_label("What moves the object").select_option("log")
    visit.page.set_input_files("[data-log]", [arm / "meta/info.json", arm / "episode_000004.parquet"])
    visit.page.get_by_label("Episode in the log").fill("4")
    visit.page.get_by_role("button", name="Make the scene").click()
    visit.page.wait_for_url(re.compile(r"/jobs/job_"))
    with world.database.session() as session:
        job = jobs.get_job(session, visit.page.url.rpartition("/")[2])
        (shard,) = session.query(ShardRow).where(ShardRow.job_id == job.id).all()
        jobs.cancel_job(session, job.id)
    data = world.stores.artifacts.read_bytes(job.inputs[0].digest or "")
    with zipfile.ZipFile(io.BytesIO(data)) as sent:
        assert {
            "episode_000004.parquet",
            "info.json",
            "color/0.png",
            "depth/11.png",
            "camera_intrinsic.json",
        } <= set(sent.namelist())
    assert (
        job.config["gripper"] == {"log": "episode_000004.parquet", "log_episode": 4}
        and shard.kind == "tracking"
    )
    visit.open("/trackings")
    visit.page.set_input_files("#pictures", tmp_path / "robot.csv")
    visit.page.get_by_role("button", name="Look").click()
    expect(visit.page.locator("[data-told] li").first).to_contain_text("neither a zip nor a tar")
    visit.errors.clear()  # Chromium notes the 422 itself
