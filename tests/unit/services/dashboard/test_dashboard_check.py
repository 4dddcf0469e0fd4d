"""The card of a check on its scene's page: a button that starts one, and the tables of its answer."""

from __future__ import annotations

import pytest
from checked import REPORT
from dashboard_served import Served, from_page, work
from tiny_scene import register, tiny_scene

from physworld_storage import checks

pytestmark = pytest.mark.slow


def test_the_button_of_the_card_starts_a_check_and_the_card_shows_its_answer(dashboard: Served) -> None:
    database, stores, client = dashboard.database, dashboard.stores, dashboard.client
    scene = register(tiny_scene(), database, stores.artifacts)
    page = client.get(f"/dashboard/scenes/{scene}").text
    card = page.partition('id="check"')[2].partition("</section>")[0]
    assert "Not checked yet" in card and 'action="/dashboard/start/check"' in card
    assert f'name="scene_id" value="{scene}"' in card
    own = from_page(client)
    started = client.post("/dashboard/start/check", data={"scene_id": scene}, headers=own)
    assert started.status_code == 303
    job_page = started.headers["location"]
    assert "follow its job" in client.get(f"/dashboard/scenes/{scene}").text
    work(database, lambda lease: {"report": REPORT})
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


def test_the_form_of_a_check_takes_other_settings(dashboard: Served) -> None:
    database, stores, client = dashboard.database, dashboard.stores, dashboard.client
    scene = register(tiny_scene(), database, stores.artifacts)
    form = client.get(f"/dashboard/start/check?scene_id={scene}").text
    for field in ("config.noise_m", "config.discrepancy_share", "config.motions", "config.candidates"):
        assert f'name="{field}"' in form, field
    own = from_page(client)
    sent = {"scene_id": scene, "config.noise_m": "0.002", "config.motions": "0"}
    assert client.post("/dashboard/start/check", data=sent, headers=own).status_code == 303
    wrong = client.post("/dashboard/start/check", data={**sent, "config.noise_m": "-1"}, headers=own)
    assert wrong.status_code == 422 and "greater than 0" in wrong.text
    with database.reading() as session:
        (check,) = checks.list_checks(session, scene_id=scene).data
    assert (check.config.noise_m, check.config.motions) == (0.002, 0)
