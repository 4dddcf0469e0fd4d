"""How people find things on the pages: a search whose address can be passed on, and the lineage as a graph."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest
from dashboard_browser import Visit
from dashboard_world import World
from playwright.sync_api import expect

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.mark.parametrize(
    ("path", "hit", "rows"),
    [
        ("/scenes", "chain", "tbody tr"),
        ("/fits", "chain ready", "tbody tr"),
        ("/traces", "named", "tbody tr"),
        ("/datasets", "sealed", "tbody tr"),
        ("/models", "swing", "tbody tr"),
        ("/models/chain_swing", "ready", "tbody tr"),
        ("/rollouts", "chain_swing", "tbody tr"),
        ("/plans", "chain ready", "tbody tr"),
        ("/", "pipeline", ".job"),
    ],
)
def test_every_list_is_searched_and_its_address_says_what_for(
    visit: Visit, path: str, hit: str, rows: str
) -> None:
    visit.open(path)
    box = visit.page.get_by_role("searchbox")
    box.fill(hit)
    box.press("Enter")
    expect(visit.page.locator(rows).first).to_be_visible()
    address = visit.page.url
    assert f"q={hit.replace(' ', '+')}" in address
    visit.page.goto(address)  # what another person is sent
    expect(visit.page.get_by_role("searchbox")).to_have_value(hit)
    expect(visit.page.locator(rows).first).to_be_visible()

    visit.open(f"{path}?q=zzz+nothing")
    expect(visit.page.locator("main")).to_contain_text("fits")
    visit.page.get_by_role("link", name="Show all").first.click()
    expect(visit.page.locator(rows).first).to_be_visible()


def test_a_scene_is_labelled_on_its_page_and_found_by_its_tags(visit: Visit, world: World) -> None:
    visit.open(f"/scenes/{world.scene_id}")
    visit.page.get_by_label("Tags, with commas between").fill("swinging, day 2")
    visit.page.get_by_role("button", name="Keep", exact=True).click()
    expect(visit.page.locator(".facts .badge.tag")).to_have_text(["swinging", "day 2"])
    visit.open("/scenes")
    box = visit.page.get_by_role("searchbox")
    box.fill("swinging")
    box.press("Enter")
    expect(visit.page.locator("tbody tr")).to_have_count(1)
    expect(visit.page.locator("tbody tr")).to_contain_text("day 2")
    visit.page.get_by_role("link", name="day 2").click()
    expect(visit.page.locator("tbody tr")).to_have_count(1)
    visit.open(f"/scenes/{world.scene_id}")
    visit.page.get_by_label("Tags, with commas between").fill("")
    visit.page.get_by_role("button", name="Keep", exact=True).click()
    expect(visit.page.locator(".facts .badge.tag")).to_have_count(0)


def test_a_dataset_is_downloaded_for_lerobot_from_its_page(
    visit: Visit, world: World, tmp_path: Path
) -> None:
    visit.open(f"/datasets/{world.dataset_id}")
    with visit.page.expect_download() as download:
        visit.page.get_by_role("link", name="LeRobot v3.0").click()
    assert download.value.suggested_filename == f"{world.dataset_id}-lerobot.zip"
    download.value.save_as(tmp_path / "kept.zip")
    with zipfile.ZipFile(tmp_path / "kept.zip") as archive:
        info = json.loads(archive.read(f"{world.dataset_id}/meta/info.json"))
    assert (info["total_episodes"], info["total_frames"]) == (3, 120)


def test_a_filter_of_states_keeps_the_words(visit: Visit) -> None:
    visit.open("/?q=chain")
    visit.page.get_by_role("link", name="failed", exact=True).click()
    expect(visit.page).to_have_url(f"{visit.base}/?state=failed&q=chain")
    expect(visit.page.locator(".job").first).to_have_attribute("data-state", "failed")
    visit.open("/fits")
    visit.page.get_by_label("State").select_option("failed")
    visit.page.get_by_role("button", name="Search").click()
    expect(visit.page).to_have_url(f"{visit.base}/fits?q=&state=failed")
    expect(visit.page.locator("tbody .badge").first).to_have_text("failed")


def test_the_lineage_leads_from_a_version_to_its_recording_by_the_keyboard(
    visit: Visit, world: World
) -> None:
    visit.open("/models/chain_swing/1")
    picture = visit.page.locator("svg.lineage")
    expect(picture.locator("a.model[aria-current]")).to_have_count(1)
    kinds = picture.locator("a").evaluate_all("links => links.map(link => link.classList[0])")
    assert kinds[0] == "scene"
    assert {"fit", "dataset", "model", "rollout", "plan"} <= set(kinds)
    picture.locator("a.fit").focus()
    ring = picture.locator("a.fit rect").evaluate("box => getComputedStyle(box).strokeWidth")
    visit.page.keyboard.press("Tab")
    assert visit.page.evaluate("document.activeElement.closest('svg.lineage') !== null")
    assert float(ring.removesuffix("px")) > 2
    picture.locator("a.scene").focus()
    visit.page.keyboard.press("Enter")
    expect(visit.page).to_have_url(f"{visit.base}/scenes/{world.scene_id}")
    visit.page.locator("svg.lineage a.rollout").first.click()
    expect(visit.page).to_have_url(f"{visit.base}/rollouts/{world.rollout_id}")
    expect(visit.page.locator("svg.lineage a.rollout[aria-current]")).to_have_count(1)
    for path in (f"/datasets/{world.dataset_id}", f"/traces/{world.trace_id}", f"/plans/{world.plan_id}"):
        visit.open(path)
        expect(visit.page.locator("svg.lineage a[aria-current]")).to_have_count(1)
