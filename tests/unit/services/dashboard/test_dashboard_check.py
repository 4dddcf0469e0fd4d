"""The card of a check on its scene's page: a button that starts one, and the tables of its answer."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from checked import REPORT
from fastapi import FastAPI
from serving import serve
from test_dashboard_access import browser_at, login
from tiny_scene import register, tiny_scene

from physworld_services.dashboard import mount
from physworld_services.stores import Stores
from physworld_storage import checks
from physworld_storage.database import Database, open_database
from physworld_storage.jobs import leases
from physworld_storage.settings import Settings

pytestmark = pytest.mark.slow


@pytest.fixture
def world(tmp_path: Path) -> Iterator[tuple[Settings, Database, Stores]]:
    settings = Settings(data_dir=tmp_path)
    database = open_database(settings)
    database.upgrade()
    yield settings, database, Stores(settings)
    database.dispose()


@pytest.fixture
def client(world: tuple[Settings, Database, Stores]) -> Iterator[httpx.Client]:
    app = FastAPI()
    mount(app, *world)
    with serve(app) as origin, browser_at(origin) as client:
        login(client, world[1])
        yield client


def test_the_button_of_the_card_starts_a_check_and_the_card_shows_its_answer(
    client: httpx.Client, world: tuple[Settings, Database, Stores]
) -> None:
    _, database, stores = world
    scene = register(tiny_scene(), database, stores.artifacts)
    page = client.get(f"/dashboard/scenes/{scene}").text
    card = page.partition('id="check"')[2].partition("</section>")[0]
    assert "Not checked yet" in card and 'action="/dashboard/start/check"' in card
    assert f'name="scene_id" value="{scene}"' in card
    own = {"origin": str(client.base_url).rstrip("/")}
    started = client.post("/dashboard/start/check", data={"scene_id": scene}, headers=own)
    assert started.status_code == 303
    job_page = started.headers["location"]
    assert "follow its job" in client.get(f"/dashboard/scenes/{scene}").text
    with database.session() as session:
        (waiting,) = leases.publishable(session)
        lease = leases.claim(session, waiting.shard_id, "test", 60.0)
        assert lease is not None and leases.complete(session, lease, {"report": REPORT})
    card = client.get(f"/dashboard/scenes/{scene}").text.partition('id="check"')[2].partition("</section>")[0]
    for text in (
        "Young&#39;s modulus", "190,000 to 210,000", "air drag linear", "only if large", "4.25 1/s", "never",
        "0 of 3 shapes", "actuation lag, measurement clock", "Shake the grip along &lt;x&gt;", "Check again",
    ):  # fmt: skip
        assert text in card, text
    with database.reading() as session:
        (check,) = checks.list_checks(session, scene_id=scene).data
    assert f"/dashboard/checks/{check.id}" in client.get(job_page).text
    there = client.get(f"/dashboard/checks/{check.id}")
    assert there.status_code == 303 and there.headers["location"] == f"/dashboard/scenes/{scene}#check"
    place = f"/dashboard/checks/{check.id}/json"
    kept = client.get(place)
    assert f'href="{place}"' in card and kept.json()["report"]["noise_m"] == check.report.noise_m
    assert f'filename="{check.id}.json"' in kept.headers["content-disposition"]
    assert client.post(f"/dashboard/delete/check/{check.id}", headers=own).status_code == 303
    assert "Not checked yet" in client.get(f"/dashboard/scenes/{scene}").text


def test_the_form_of_a_check_takes_other_settings(
    client: httpx.Client, world: tuple[Settings, Database, Stores]
) -> None:
    _, database, stores = world
    scene = register(tiny_scene(), database, stores.artifacts)
    form = client.get(f"/dashboard/start/check?scene_id={scene}").text
    for field in ("config.noise_m", "config.discrepancy_share", "config.motions", "config.candidates"):
        assert f'name="{field}"' in form, field
    own = {"origin": str(client.base_url).rstrip("/")}
    sent = {"scene_id": scene, "config.noise_m": "0.002", "config.motions": "0"}
    assert client.post("/dashboard/start/check", data=sent, headers=own).status_code == 303
    wrong = client.post("/dashboard/start/check", data={**sent, "config.noise_m": "-1"}, headers=own)
    assert wrong.status_code == 422 and "greater than 0" in wrong.text
    with database.reading() as session:
        (check,) = checks.list_checks(session, scene_id=scene).data
    assert (check.config.noise_m, check.config.motions) == (0.002, 0)
