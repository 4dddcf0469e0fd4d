"""The pages in a window of 360 px: plots can be read, buttons can be reached, text stays in its box."""

from __future__ import annotations

import pytest
from dashboard_browser import Visit
from dashboard_world import World
from playwright.sync_api import Browser, expect

from physworld_storage.access import api_keys

pytestmark = pytest.mark.browser
READABLE_PX = 9.0
BEYOND = """(box) => {
  const [range, found] = [document.createRange(), []];
  const walk = document.createTreeWalker(box, NodeFilter.SHOW_TEXT);
  const edge = box.getBoundingClientRect();
  while (walk.nextNode()) {
    range.selectNodeContents(walk.currentNode);
    for (const line of range.getClientRects()) {
      if (line.width && (line.right > edge.right || line.left < edge.left)) found.push(walk.currentNode.data.trim());
    }
  }
  return found;
}"""
"""Texts that reach over the sides of an element."""


@pytest.fixture
def phone(visit: Visit) -> Visit:
    """The tab in a window as wide as a phone."""
    visit.page.set_viewport_size({"width": 360, "height": 900})
    return visit


@pytest.mark.parametrize("width", [360, 800, 1440])
def test_the_text_of_a_plot_can_be_read_and_nothing_is_empty_below_it(
    visit: Visit, world: World, width: int
) -> None:
    visit.page.set_viewport_size({"width": width, "height": 900})
    visit.open(f"/scenes/{world.scene_id}")
    curves = visit.page.locator("[data-curve][data-ready]")
    expect(curves).to_have_count(2)
    for curve in curves.all():
        sizes: list[float] = curve.evaluate("""(curve) => [...curve.querySelectorAll("svg.chart text")]
            .filter((text) => text.checkVisibility())
            .map((text) => parseFloat(getComputedStyle(text).fontSize) * text.getScreenCTM().d)
            .filter((size) => size > 0)""")
        assert sizes and min(sizes) >= READABLE_PX
        empty = curve.evaluate("(curve) => curve.getBoundingClientRect().bottom"
                               " - curve.lastElementChild.getBoundingClientRect().bottom")  # fmt: skip
        assert empty <= 1


def test_the_lineage_fits_its_panel_although_its_columns_are_wider(visit: Visit) -> None:
    visit.page.set_viewport_size({"width": 920, "height": 900})
    visit.open("/models/chain_swing/1")
    graph = visit.page.locator("svg.lineage")
    expect(graph.locator(".column")).to_have_count(5)
    wanted, drawn, room = graph.evaluate(
        "graph => [graph.viewBox.baseVal.width, graph.getBoundingClientRect().width, graph.parentElement.clientWidth]"
    )
    assert drawn <= room < wanted


def test_text_stays_in_the_box_for_uploads(phone: Visit) -> None:
    phone.open("/scenes")
    assert phone.page.locator("form.upload").evaluate(BEYOND) == []


def test_buttons_of_a_table_are_in_the_window(stranger: Visit, world: World, browser: Browser) -> None:
    with world.database.session() as session:
        api_keys.create_key(session, "the robot in the laboratory", "write")
    stranger.open("/login")
    stranger.login(world.admin_token)
    other = browser.new_context()
    second = Visit(other.new_page(), stranger.base)
    second.open("/login")
    second.login(world.admin_token)
    other.close()
    stranger.page.set_viewport_size({"width": 360, "height": 900})
    for path, name in (("/keys", "Revoke"), ("/sessions", "End")):
        stranger.open(path)
        button = stranger.page.locator("table").get_by_role("button", name=name).first
        box = button.bounding_box()
        assert box is not None
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 360
