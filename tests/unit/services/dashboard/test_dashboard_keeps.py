"""What the pages give to keep and take in: files of a dataset, pictures of a scene, settings, who did what."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator

import httpx
import numpy as np
import pytest
from dashboard_world import World, build_world
from fastapi import FastAPI
from serving import log_in, serve

from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_services.api.limits import PICTURE_PATH
from physworld_services.dashboard import mount
from physworld_services.dashboard.lists import Looked
from physworld_services.dashboard.pages_jobs import Entry
from physworld_services.dashboard.site import environment_of_pages
from physworld_services.dashboard.starts import MADE_OF
from physworld_storage import resources, runs, signing
from physworld_storage.jobs import jobs

pytestmark = pytest.mark.slow

CAMERA = {
    "width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0,
    "world_to_camera": np.eye(4).tolist(),
}  # fmt: skip


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return build_world(tmp_path_factory.mktemp("dashboard"))


@pytest.fixture(scope="module")
def origin(world: World) -> Iterator[str]:
    app = FastAPI()
    mount(app, world.settings, world.database, world.stores)
    with serve(app) as origin:
        yield origin


def browser(origin: str, token: str) -> httpx.Client:
    headers = {"accept": "text/html", **log_in(origin, token)}
    return httpx.Client(base_url=f"{origin}/dashboard", headers=headers, trust_env=False)


@pytest.fixture
def writer(origin: str, world: World) -> Iterator[httpx.Client]:
    with browser(origin, world.writer_token) as client:
        yield client


def test_a_dataset_gives_its_manifest_every_episode_and_the_ways_to_export_it(
    writer: httpx.Client, world: World
) -> None:
    place = f"/datasets/{world.dataset_id}"
    page = writer.get(place).text
    with world.database.reading() as session:
        dataset = resources.get_dataset(session, world.dataset_id)
    assert f'href="/dashboard/artifacts/{dataset.digest}?name=manifest.json"' in page
    assert writer.get(f"/artifacts/{dataset.digest}").json()["dataset_id"] == world.dataset_id
    for form in ("npz", "ply", "lerobot"):
        assert f"physworld datasets export {world.dataset_id} --format {form}<" in page
    assert f'href="/dashboard{place}/episodes/2/npz"' in page
    kept = writer.get(f"{place}/episodes/2/npz")
    assert f"{world.dataset_id}-00002.npz" in kept.headers["content-disposition"]
    with np.load(io.BytesIO(kept.content), allow_pickle=False) as arrays:
        assert arrays["particles"].shape == (40, 300, 3)
    assert writer.get(f"{place}/episodes/3/npz").status_code == 404


def test_the_list_of_jobs_says_how_much_time_is_left(world: World) -> None:
    with world.database.reading() as session:
        running = jobs.get_job(session, world.running_id)

    def row(job: Job) -> str:
        left = job.model_copy(update={"progress": job.progress.model_copy(update={"eta_s": 240.0})})
        context = {"entries": [Entry(left, "chain")], "counts": [], "filters": (), "has_sample": False}
        template = environment_of_pages().get_template("_jobs.html")
        return template.render(may_write=False, **context, **Looked().context(None))

    assert "10 of 80 simulations, about 4 min left</span>" in row(running)
    pipeline = running.model_copy(update={"kind": "pipeline", "share": 0.125})
    assert "<span>12 %, about 4 min left</span>" in row(pipeline)
    assert "left" not in row(running.model_copy(update={"state": "succeeded"}))


@pytest.mark.parametrize("kind", ["rollout", "plan"])
def test_a_run_that_is_started_again_begins_with_what_it_was_given(
    writer: httpx.Client, world: World, kind: runs.RunKind
) -> None:
    given = {"motion_scale": "1.75"} if kind == "rollout" else {"shift_x_m": "0.031", "shift_z_m": "-0.02"}
    asked = {"model": "chain_swing", "version": "1", **given}
    started = writer.post(f"/start/{kind}", data=asked)
    assert started.status_code == 303, started.text
    job_id = started.headers["location"].rpartition("/")[2]
    form = writer.get(f"/start/{kind}?job={job_id}").text
    for name, value in given.items():
        assert f'name="{name}" value="{value}"' in form, name
    assert "given as arrays" not in form
    with world.database.session() as session:
        assert MADE_OF[kind] <= jobs.get_job(session, job_id).config.keys()
        jobs.cancel_job(session, job_id)


def test_a_run_whose_arrays_came_from_elsewhere_says_so_in_its_form(
    writer: httpx.Client, world: World
) -> None:
    for kind, run_id in (("rollout", world.rollout_id), ("plan", world.plan_id)):
        with world.database.reading() as session:
            job_id = runs.get_run(session, kind, run_id).job_id  # type: ignore[arg-type]
        assert "was given as arrays" in writer.get(f"/start/{kind}?job={job_id}").text
    assert "given as arrays" not in writer.get("/start/rollout").text


def test_pictures_come_in_beside_a_scene_and_a_wrong_one_is_refused(
    writer: httpx.Client, world: World, origin: str
) -> None:
    place = f"/scenes/{world.scene_id}"
    page = writer.get(place).text
    for name in ("camera.json", "frames.npz", "splat.ply"):
        assert f'action="/dashboard{place}/pictures/{name}"' in page
    sent = {"bundle": ("seen.json", json.dumps(CAMERA))}
    answer = writer.post(f"{place}/pictures/camera.json", files=sent)
    assert (answer.status_code, answer.headers["location"]) == (303, f"/dashboard{place}#pictures")
    page = writer.get(place).text
    assert "camera.json, kept" in page and "?name=camera.json" in page
    wrong = writer.post(f"{place}/pictures/camera.json", files={"bundle": ("a.json", '{"width": 3}')})
    assert wrong.status_code == 422 and "body.bundle.height: Field required" in wrong.text
    wrong = writer.post(f"{place}/pictures/splat.ply", files={"bundle": ("a.ply", "no")})
    assert wrong.status_code == 422 and wrong.text.count("begins with") == 1
    assert writer.post(f"{place}/pictures/cat.gif", files=sent).status_code == 422
    assert writer.post("/scenes/scn_unknown/pictures/camera.json", files=sent).status_code == 404
    assert PICTURE_PATH.fullmatch(f"/dashboard{place}/pictures/splat.ply"), "as long as an upload may be"
    with browser(origin, world.reader_token) as reader:
        assert "/pictures/" not in reader.get(place).text
        assert reader.post(f"{place}/pictures/camera.json", files=sent).status_code == 403


def test_administrators_read_the_audit_log_and_the_keys_that_sign(
    writer: httpx.Client, world: World, origin: str
) -> None:
    signer = signing.open_signer(world.settings)
    with world.database.session() as session:
        signing.register(session, signer)
        job = jobs.create_fit(session, world.scene_id, FitConfig())
    writer.post(f"/jobs/{job.id}/cancel")
    with browser(origin, world.admin_token) as admin:
        log = admin.get("/keys/audit").text
        assert (
            "job.cancelled" in log and job.id in log and "<td>writer " in log.replace(' class="nowrap"', "")
        )
        page = admin.get("/keys").text
    assert 'href="/dashboard/keys/audit"' in page and signer.key_id in page
    assert signer.public_key.replace("+", "&#43;") in page or signer.public_key in page
    for path in ("/keys", "/keys/audit"):
        assert writer.get(path).status_code == 403
