"""Ropes are drawn as tubes and cloths as sheets, in the playground and on a rollout's page, beside the recording."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from dashboard_browser import Visit
from inference_serving import Served, serve_inference
from playwright.sync_api import expect
from published_tiny import publish_tiny, tiny_model
from service_process import until

from physworld_schemas.arrays import EncodedArray
from physworld_storage.jobs import jobs, leases

pytestmark = pytest.mark.browser

KINDS = {"rope": "tube", "sheet": "skin", "beam": "skin"}
FRAMES, NAME = 40, "tiny-{}"
WAIT_S, LEASE_S = 60.0, 60.0
PART_M = 8e-3  # of a cell of the bar: a vertex may lie in one that is hardly filled, outside of the surface
DRAWN = """() => { const body = %s; const out = body.attribute.array;
    const low = [1e9, 1e9, 1e9], high = [-1e9, -1e9, -1e9];
    out.forEach((value, i) => {
        low[i %% 3] = Math.min(low[i %% 3], value); high[i %% 3] = Math.max(high[i %% 3], value); });
    return { low, high, visible: body.mesh.visible, kind: body.data.kind, broken: out.some(Number.isNaN) }; }"""
PLAYED, PLAYER = DRAWN % "window.playgrounds[0].surface", DRAWN % "window.players[0].bodies[0].surface"


@dataclass(frozen=True)
class Kept:
    """A rollout that is stored: its id and what it predicts of the vertices, (T, n, 3) [m]."""

    id: str
    vertices: np.ndarray


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serve_inference(tmp_path_factory.mktemp("data")) as served:
        for kind in KINDS:
            publish_tiny(served.database, served.stores.artifacts, name=NAME.format(kind), kind=kind)
        yield served


@pytest.fixture(scope="module")
def base(served: Served) -> str:
    return f"{served.url}/dashboard"


def kept_rollout(served: Served, kind: str) -> Kept:
    """What the model predicts when its grips go up by 3 cm, stored as a worker does."""
    model = tiny_model(kind)[2]
    begun = len(model.start_controllers)
    controllers = np.repeat(model.start_controllers[-1:], FRAMES, axis=0)
    controllers[:begun] = model.start_controllers
    controllers[begun:, :, 2] += np.minimum(np.arange(FRAMES - begun) / 20, 1.0)[:, None] * 0.03
    vertices = model.rollout(controllers).astype(np.float32)
    put = served.stores.artifacts.put_bytes
    asked = json.dumps({"controllers": EncodedArray.of(controllers).model_dump()}).encode()
    request = put(asked, "request.json", "application/json")
    with served.database.session() as session:
        config = {"start": "recording"}
        job = jobs.create_run(session, "rollout", NAME.format(kind), 1, config, request, FRAMES)
    with served.database.session() as session:
        waiting = next(item for item in leases.publishable(session, 100) if item.kind == "rollout")
        leases.mark_published(session, [waiting])
        lease = leases.claim(session, waiting.shard_id, "test", LEASE_S)
        assert lease is not None
        buffer = io.BytesIO()
        points = model.skin.apply(vertices)
        np.savez(
            buffer, times=np.arange(FRAMES) * model.spec.dt_s, points=points[None], vertices=vertices[None]
        )
        result = put(buffer.getvalue(), "rollout.npz")
        figures = {
            "seconds": 0.1,
            "ticks": FRAMES,
            "candidates": 1,
            "dt_s": model.spec.dt_s,
            "speed_m_s": 0.1,
        }
        assert leases.complete(session, lease, {"figures": figures, "artifacts": [result.model_dump()]}, None)
    return Kept(str(job.outputs[0].id), vertices)


@pytest.mark.parametrize("kind", KINDS)
def test_the_playground_draws_the_body_and_the_recording(
    served: Served, stranger: Visit, kind: str, tmp_path: Path
) -> None:
    page = stranger.page
    stranger.open(f"/models/{NAME.format(kind)}/1/playground")
    stranger.login(served.token)
    page.wait_for_selector("[data-playground][data-ready][data-accompanied]")
    figure = page.locator("[data-playground]")
    until(lambda: int(figure.get_attribute("data-frames") or 0) > 60, "no frames came", WAIT_S)
    expect(page.get_by_label("as a surface")).to_be_checked()
    expect(page.get_by_label("Recording")).to_be_checked()
    before = page.evaluate(PLAYED)
    assert before["visible"] and not before["broken"]
    assert before["kind"] == KINDS[kind]
    assert not page.evaluate("() => window.playgrounds[0].body.points.visible")
    assert page.evaluate("() => window.playgrounds[0].ghost.clouds.length") == 1
    page.focus("[data-playground] canvas")
    page.keyboard.down("PageUp")
    until(
        lambda: page.evaluate(PLAYED)["high"][2] > before["high"][2] + 0.02, "the body did not follow", WAIT_S
    )
    page.keyboard.up("PageUp")
    page.screenshot(path=str(tmp_path / f"playground-{kind}.png"))


@pytest.mark.parametrize("kind", KINDS)
def test_the_page_of_a_rollout_draws_the_body_and_the_recording(
    served: Served, stranger: Visit, kind: str, tmp_path: Path
) -> None:
    rollout, page = kept_rollout(served, kind), stranger.page
    stranger.open(f"/rollouts/{rollout.id}")
    stranger.login(served.token)
    stranger.points_shown()
    expect(page.get_by_label("Surface")).to_be_checked()
    expect(page.get_by_label("Recording")).to_be_checked()
    expect(page.get_by_label("Vertices")).not_to_be_checked()
    for frame in (0, FRAMES - 1):
        page.evaluate(f"() => window.players[0].seek({frame})")
        drawn, places = page.evaluate(PLAYER), rollout.vertices[frame]
        assert drawn["visible"] and not drawn["broken"]
        around = 0.5 * np.ptp(rollout.vertices[0], axis=0).max()
        assert (np.array(drawn["low"]) < places.min(axis=0) + PART_M).all()
        assert (np.array(drawn["high"]) > places.max(axis=0) - PART_M).all()
        assert (np.array(drawn["low"]) > places.min(axis=0) - around).all()
        assert (np.array(drawn["high"]) < places.max(axis=0) + around).all()
    page.screenshot(path=str(tmp_path / f"rollout-{kind}.png"))
    page.get_by_label("Surface").uncheck()
    assert not page.evaluate(PLAYER)["visible"]
