"""The player of a film in a browser: it loads the film by ranges, fits every window, and axe finds nothing."""

from __future__ import annotations

import numpy as np
import pytest
from dashboard_browser import Visit
from dashboard_world import World, claim
from test_dashboard_accessible import WIDTHS, violations

from physworld.video import encode_mp4
from physworld_schemas.video import VideoCreate
from physworld_storage.jobs import jobs, leases

pytestmark = pytest.mark.browser
FRAMES, FPS = 30, 30.0
WIDTH, HEIGHT = 1280, 720
PLAYS_H264 = "document.createElement('video').canPlayType('video/mp4; codecs=\"avc1.42E01E\"') !== ''"


def add_film(world: World) -> None:
    """A film of the scene's recording: a bar that brightens."""
    shades = np.linspace(40, 200, FRAMES).astype(np.uint8)
    film = encode_mp4((np.full((HEIGHT, WIDTH, 3), shade) for shade in shades), FPS)
    with world.database.session() as session:
        job = jobs.create_video(session, VideoCreate(of="scene", id=world.scene_id))
    lease = claim(world, job.id)
    made = world.stores.artifacts.put_bytes(film, "film.mp4", "video/mp4")
    camera = {"width": WIDTH, "height": HEIGHT, "fx": 900.0, "fy": 900.0, "cx": 640.0, "cy": 360.0}
    report = {
        "frames": FRAMES,
        "fps": FPS,
        "drawn": "points",
        "gaussians": 9,
        "seen_from": "whole",
        "seconds": 1.0,
    }
    report |= {
        "camera": {**camera, "world_to_camera": np.eye(4).tolist()},
        "not_scored": "the scene has no pictures",
    }
    with world.database.session() as session:
        assert leases.complete(
            session, lease, {"report": report, "artifacts": [made.model_dump()]}, made.sha256
        )


def test_the_player_loads_the_film_and_fits_the_window(stranger: Visit, world: World) -> None:
    add_film(world)
    stranger.open("/login")
    stranger.login(world.admin_token)
    for width in WIDTHS:
        stranger.page.set_viewport_size({"width": width, "height": 900})
        stranger.open(f"/scenes/{world.scene_id}")
        player = stranger.page.locator("#films video")
        player.wait_for()
        assert violations(stranger) == []
        assert stranger.page.evaluate("document.documentElement.scrollWidth") <= width
        box = player.bounding_box()
        assert box is not None and 0 < box["width"] <= min(width, WIDTH)
        if stranger.page.evaluate(PLAYS_H264):
            stranger.page.wait_for_function("document.querySelector('#films video').readyState >= 1")
            assert player.evaluate("(film) => film.duration") == pytest.approx(FRAMES / FPS, abs=0.05)
            assert player.evaluate("(film) => [film.videoWidth, film.videoHeight]") == [WIDTH, HEIGHT]
            assert box["width"] / box["height"] == pytest.approx(WIDTH / HEIGHT, rel=0.01)
    assert [url for url in stranger.requests if url.endswith("/film.mp4")]


def test_a_film_of_points_is_dark_in_the_dark(visit: Visit, world: World) -> None:
    add_film(world)
    filters = {}
    for scheme in ("light", "dark"):
        visit.page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        visit.open(f"/scenes/{world.scene_id}")
        filters[scheme] = visit.page.locator("#films video").evaluate("film => getComputedStyle(film).filter")
    assert filters["light"] == "none"
    assert filters["dark"].startswith("invert")
