"""The player of films: a button that asks for one, its states, the file by ranges, and where a film's page is."""

from __future__ import annotations

from datetime import UTC, datetime

import httpx
import numpy as np
import pytest
from dashboard_served import Served, from_page, work
from tiny_scene import register, tiny_scene

from physworld_schemas.video import Video, VideoConfig
from physworld_services.dashboard.pages_videos import page_of
from physworld_storage import videos

pytestmark = pytest.mark.slow

FILM = bytes(range(200))
REPORT = {
    "frames": 12, "fps": 30.0, "drawn": "splat", "gaussians": 4, "seen_from": "scene", "seconds": 1.0,
    "camera": {
        "width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0,
        "world_to_camera": np.eye(4).tolist(),
    },
    "scores": {
        "psnr_db": 31.25, "ssim": 0.943, "lpips": 0.0625, "lpips_per_frame": [0.0625] * 12,
        "psnr_db_per_frame": [31.25] * 12, "ssim_per_frame": [0.943] * 12,
    },
}  # fmt: skip


def card(client: httpx.Client, scene: str) -> str:
    return client.get(f"/dashboard/scenes/{scene}").text.partition('id="films"')[2].partition("</section>")[0]


def test_the_button_of_a_scene_asks_for_a_film_and_the_page_plays_it(dashboard: Served) -> None:
    database, stores, client = dashboard.database, dashboard.stores, dashboard.client
    scene = register(tiny_scene(), database, stores.artifacts)
    assert "Nothing has been filmed yet" in card(client, scene)
    assert f'name="id" value="{scene}"' in card(client, scene)
    own = from_page(client)
    asked = client.post("/dashboard/start/video", data={"of": "scene", "id": scene}, headers=own)
    assert asked.status_code == 303
    assert "follow its job" in card(client, scene) and "<video" not in card(client, scene)
    made = stores.artifacts.put_bytes(FILM, "film.mp4", "video/mp4").model_dump()
    work(database, lambda lease: {"report": REPORT, "artifacts": [made]})
    with database.reading() as session:
        (film,) = videos.list_videos(session).data
    shown = card(client, scene)
    address = f"/dashboard/videos/{film.id}/film.mp4"
    for text in (
        f'src="{address}"',
        "12 frames",
        "4 Gaussians",
        "PSNR 31.2",
        "SSIM 0.943, LPIPS 0.0625",
        "camera of the scene",
    ):
        assert text in shown, text
    whole = client.get(address)
    assert (whole.status_code, whole.content, whole.headers["content-type"]) == (200, FILM, "video/mp4")
    part = client.get(address, headers={"Range": "bytes=10-19"})
    assert (part.status_code, part.content) == (206, FILM[10:20])
    assert part.headers["content-range"] == "bytes 10-19/200"
    assert client.get(address, headers={"Range": "bytes=900-"}).status_code == 416
    assert "media-src 'self'" in client.get(f"/dashboard/scenes/{scene}").headers["content-security-policy"]
    job_page = client.get(asked.headers["location"]).text
    assert f"/dashboard/videos/{film.id}" in job_page
    there = client.get(f"/dashboard/videos/{film.id}")
    assert there.status_code == 303 and there.headers["location"] == f"/dashboard/scenes/{scene}#films"
    form = client.get(f"/dashboard/start/video?job={film.job_id}").text
    assert f'value="{scene}"' in form and 'name="config.azimuth_deg"' in form
    assert client.post(f"/dashboard/delete/video/{film.id}", headers=own).status_code == 303
    assert "Nothing has been filmed yet" in card(client, scene)
    assert client.get(address).status_code == 404


def test_a_film_with_its_recording_has_a_switch_and_both_files(dashboard: Served) -> None:
    database, stores, client = dashboard.database, dashboard.stores, dashboard.client
    scene = register(tiny_scene(), database, stores.artifacts)
    own = from_page(client)
    client.post("/dashboard/start/video", data={"of": "scene", "id": scene}, headers=own)
    put = stores.artifacts.put_bytes
    made = [put(FILM, "film.mp4", "video/mp4"), put(FILM[::-1], "recording.mp4", "video/mp4")]
    found = {"report": REPORT, "artifacts": [item.model_dump() for item in made]}
    work(database, lambda lease: found)
    with database.reading() as session:
        (film,) = videos.list_videos(session).data
    shown = card(client, scene)
    assert 'data-frames="12"' in shown and "/static/film" in shown
    for choice in ("Drawing", "Recording", "Overlay", "Side by side"):
        assert f"{choice}</label>" in shown, choice
    for name, content in (("film.mp4", FILM), ("recording.mp4", FILM[::-1])):
        address = f"/dashboard/videos/{film.id}/{name}"
        assert f'src="{address}"' in shown and client.get(address).content == content
    assert client.get(f"/dashboard/videos/{film.id}/splat.ply").status_code == 404


@pytest.mark.parametrize(
    ("of", "source", "page"),
    [
        ("scene", "scn_1", "/scenes/scn_1"),
        ("fit", "fit_1", "/scenes/scn_1?fit=fit_1"),
        ("model", "beam:3", "/models/beam/3"),
        ("rollout", "rol_1", "/rollouts/rol_1"),
    ],
)
def test_a_film_is_played_on_the_page_of_what_it_shows(of: str, source: str, page: str) -> None:
    film = Video.model_validate(
        {
            "id": "vid_1", "of": of, "source_id": source, "scene_id": "scn_1", "state": "ready",
            "created_at": datetime.now(UTC), "job_id": "job_1", "config": VideoConfig(),
        }
    )  # fmt: skip
    assert page_of(film) == page
