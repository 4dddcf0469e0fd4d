"""The player of a film in a browser: it loads the film by ranges, fits every window, and axe finds nothing.

A film that is compared with pictures has a switch: prediction, recording, one over the other, or side by side.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from dashboard_browser import Visit
from dashboard_world import World, claim
from PIL import Image
from playwright.sync_api import expect
from test_dashboard_accessible import WIDTHS, violations

from physworld.video import encode_mp4
from physworld_schemas.video import VideoCreate
from physworld_storage.jobs import jobs, leases

pytestmark = pytest.mark.browser
FRAMES, FPS = 30, 30.0
WIDTH, HEIGHT = 1280, 720
PLAYS_H264 = "document.createElement('video').canPlayType('video/mp4; codecs=\"avc1.42E01E\"') !== ''"


STATES = """films => films.map((film) => ({
  at: film.currentTime, paused: film.paused, drawn: !film.seeking && film.readyState >= 2,
}))"""
SHADES = np.linspace(40, 200, FRAMES).astype(np.uint8)
RED, BLUE = np.array([1, 0, 0], np.uint8), np.array([0, 0, 1], np.uint8)
NEAR = 20.0  # browsers take the matrix of colours by the picture's size
WHITE = np.ones(3, np.uint8)


def brightening(colour: np.ndarray) -> bytes:
    """A film of one colour that brightens from frame to frame."""
    return encode_mp4((np.full((HEIGHT, WIDTH, 3), colour * shade) for shade in SHADES), FPS)


def add_film(world: World, **films: np.ndarray) -> None:
    """A film of the scene's recording, by name ``film`` and perhaps ``recording``, each of one colour."""
    with world.database.session() as session:
        job = jobs.create_video(session, VideoCreate(of="scene", id=world.scene_id))
    lease = claim(world, job.id)
    put = world.stores.artifacts.put_bytes
    colours = films or {"film": WHITE}
    made = [put(brightening(colour), f"{name}.mp4", "video/mp4") for name, colour in colours.items()]
    camera = {"width": WIDTH, "height": HEIGHT, "fx": 900.0, "fy": 900.0, "cx": 640.0, "cy": 360.0}
    report = {
        "frames": FRAMES,
        "fps": FPS,
        "drawn": "splat" if "recording" in films else "points",
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
            session,
            lease,
            {"report": report, "artifacts": [one.model_dump() for one in made]},
            made[0].sha256,
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


def seen(visit: Visit) -> list[np.ndarray]:
    """Mean colours (3,) of the left and of the right half of the player's picture, as the browser shows it."""
    shot = visit.page.locator("#films .pair").screenshot()
    pixels = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=np.float64)
    quarter = pixels.shape[1] // 4
    middle = slice(pixels.shape[0] // 3, 2 * pixels.shape[0] // 3)
    return [pixels[middle, at - 8 : at + 8].mean(axis=(0, 1)) for at in (quarter, 3 * quarter)]


def until(visit: Visit, *wanted: tuple[bool, float | None]) -> list[float]:
    """Wait until both films are as wanted, (at rest, at which time [s] or any); their times [s]."""
    films: list[dict[str, Any]] = []
    for _ in range(300):
        films = visit.page.locator("#films video").evaluate_all(STATES)
        if all(
            film["paused"] == paused
            and (not paused or film["drawn"])
            and (at is None or abs(film["at"] - at) < 1e-3)
            for film, (paused, at) in zip(films, wanted, strict=True)
        ):
            return [film["at"] for film in films]
        visit.page.wait_for_timeout(100)
    raise AssertionError(f"after 30 s the films are {films}, not {wanted}")


def at_rest(visit: Visit, frame: int) -> None:
    """Wait until both films stand in the middle of a frame."""
    until(visit, *[(True, (frame + 0.5) / FPS)] * 2)


def test_prediction_and_recording_are_seen_alone_over_each_other_and_side_by_side(
    visit: Visit, world: World
) -> None:
    add_film(world, film=RED, recording=BLUE)
    visit.open(f"/scenes/{world.scene_id}")
    player = visit.page.locator("#films figure[data-ready]")
    player.wait_for()
    if not visit.page.evaluate(PLAYS_H264):
        pytest.skip("this Chromium plays no H.264")
    place = player.get_by_label("Frame")
    place.fill("20")
    at_rest(visit, 20)
    expect(player.locator("[data-told]")).to_have_text(f"frame 21 of {FRAMES}, {20 / FPS:.2f} s")
    red, blue = (float(SHADES[20]) * colour for colour in (RED, BLUE))
    share = player.get_by_label("Share of the drawing")
    for choice, halves in (
        ("Drawing", (red, red)),
        ("Recording", (blue, blue)),
        ("Overlay", ((red + blue) / 2, (red + blue) / 2)),
        ("Side by side", (red, blue)),
    ):
        player.get_by_label(choice, exact=True).check()
        at_rest(visit, 20)  # the switch moves neither film
        for found, wanted in zip(seen(visit), halves, strict=True):
            np.testing.assert_allclose(found, wanted, atol=NEAR, err_msg=choice)
        assert share.is_visible() == (choice == "Overlay")
        for width in WIDTHS:
            visit.page.set_viewport_size({"width": width, "height": 900})
            assert violations(visit) == []
            assert visit.page.evaluate("document.documentElement.scrollWidth") <= width
        visit.page.set_viewport_size({"width": 1280, "height": 900})
    player.get_by_label("Overlay", exact=True).check()
    share.fill("20")
    np.testing.assert_allclose(seen(visit)[0], 0.2 * red + 0.8 * blue, atol=NEAR)


def test_the_switch_works_with_the_keyboard_and_while_both_films_play(visit: Visit, world: World) -> None:
    add_film(world, film=RED, recording=BLUE)
    visit.open(f"/scenes/{world.scene_id}")
    player = visit.page.locator("#films figure[data-ready]")
    player.wait_for()
    if not visit.page.evaluate(PLAYS_H264):
        pytest.skip("this Chromium plays no H.264")
    player.get_by_label("Frame").focus()
    for _ in range(3):
        visit.page.keyboard.press("ArrowRight")
    at_rest(visit, 3)
    player.get_by_label("Drawing", exact=True).focus()
    for view in ("recording", "overlay", "beside", "prediction"):
        visit.page.keyboard.press("ArrowDown")
        expect(player).to_have_attribute("data-view", view)
    button = player.get_by_role("button", name="Play")
    button.focus()
    visit.page.keyboard.press("Enter")
    expect(player.get_by_role("button", name="Pause")).to_be_visible()
    until(visit, (False, None), (False, None))
    player.get_by_label("Overlay", exact=True).check()
    until(visit, (False, None), (False, None))
    player.get_by_role("button", name="Pause").click()
    until(visit, (True, None), (True, None))
    visit.page.wait_for_timeout(200)
    times = until(visit, (True, None), (True, None))
    assert abs(times[0] - times[1]) * FPS < 0.3 and times[0] != pytest.approx(3.5 / FPS)
