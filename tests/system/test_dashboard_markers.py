"""Markers of a table in 3D before anything is stored: what is the gripper's and which axis points up, by clicks."""

from __future__ import annotations

import re
from pathlib import Path

import marker_files
import numpy as np
import pytest
from dashboard_browser import Visit
from dashboard_world import World
from playwright.sync_api import Locator, expect
from test_dashboard_accessible import violations

from physworld_storage import resources

pytestmark = pytest.mark.browser
MOTION = marker_files.made(frames=60)
PLACE = """name => { const { viewer } = window; const { left, top } = viewer.canvas.getBoundingClientRect();
  const { place } = viewer.markers.find((marker) => marker.name === name);
  const [x, y] = viewer.pointer.seenAt(place); return [left + x, top + y]; }"""
COLOUR = """name => { const { viewer } = window; viewer.render();
  const gl = viewer.view.renderer.getContext(); const pixel = new Uint8Array(4);
  const [x, y] = viewer.pointer.seenAt(viewer.markers.find((marker) => marker.name === name).place);
  const scale = gl.drawingBufferWidth / viewer.canvas.clientWidth;
  gl.readPixels(x * scale, gl.drawingBufferHeight - y * scale, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  return [...pixel].slice(0, 3); }"""


def looked_at(visit: Visit, table: Path) -> Locator:
    """Give the page a table; the drawing of its markers."""
    visit.open("/scenes")
    visit.page.set_input_files("#bundle", table)
    visit.page.get_by_role("button", name="Upload").click()
    figure = visit.page.locator("[data-markers]")
    expect(figure).to_have_attribute("data-ready", "true")
    return figure


def click(visit: Visit, marker: str) -> None:
    """Click a marker where it is drawn, and wait for the new preview."""
    visit.page.locator("[data-markers] canvas").scroll_into_view_if_needed()
    with visit.page.expect_response(re.compile(r"/scenes/preview$")):
        visit.page.mouse.click(*visit.page.evaluate(PLACE, marker))


def row(visit: Visit, what: str) -> Locator:
    """The line of the table that says what was found."""
    return visit.page.locator("[data-told]").get_by_role("row", name=re.compile(f"^{what} "))


def test_clicks_say_what_holds_the_body_and_what_points_up(
    visit: Visit, world: World, tmp_path: Path
) -> None:
    table = tmp_path / "clicked cloth.csv"
    table.write_bytes(marker_files.columns(MOTION, up="y", unit="mm"))
    figure = looked_at(visit, table)
    legend = figure.locator("[data-legend]")
    expect(legend).to_have_text("body 16gripper 4left out 0")
    body, gripper = (np.array(visit.page.evaluate(COLOUR, name), float) for name in ("m16", "grip1"))
    assert body @ [-1, 0, 1] > 60 and gripper @ [1, -1, 0] > 60, (body, gripper)  # blue, and magenta
    for scheme, width in (("dark", 360), ("light", 1280)):
        visit.page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        visit.page.set_viewport_size({"width": width, "height": 900})
        assert violations(visit) == []
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= width
    click(visit, "m16")
    expect(legend).to_have_text("body 15gripper 5left out 0")
    expect(row(visit, "gripper")).to_contain_text("m16")
    expect(row(visit, "gripper")).to_contain_text("given")
    repainted = np.array(visit.page.evaluate(COLOUR, "m16"), float)
    assert np.abs(repainted - gripper).max() < np.abs(repainted - body).max()
    click(visit, "m16")
    expect(legend).to_have_text("body 15gripper 4left out 1")
    expect(visit.page.locator("[data-told] li", has_text="1 markers are dropped: m16")).to_be_visible()
    up = figure.get_by_role("group", name="Axis that points up")
    expect(up.get_by_role("button", name="y", exact=True)).to_have_attribute("aria-pressed", "true")
    with visit.page.expect_response(re.compile(r"/scenes/preview$")):
        up.get_by_role("button", name="-z", exact=True).click()
    expect(row(visit, "up")).to_contain_text("-z")
    expect(up.get_by_role("button", name="-z", exact=True)).to_have_attribute("aria-pressed", "true")
    lowest = "Math.min(...window.viewer.markers.map((marker) => marker.place_m[2]))"
    assert visit.page.evaluate(lowest) < 0.0  # the cloth's depth, which lies around 0
    with visit.page.expect_response(re.compile(r"/scenes/preview$")):
        up.get_by_role("button", name="y", exact=True).click()
    visit.page.locator("select[data-option=kind]").select_option("sheet")
    visit.page.get_by_label("Mass [kg]").fill("0.08")
    visit.page.get_by_role("button", name="Store the scene").click()
    visit.page.wait_for_url(re.compile(r"/scenes/scn_"))
    with world.database.session() as session:
        scene = next(one for one in resources.list_scenes(session).data if one.name == "clicked cloth")
        assert (scene.points, scene.controllers) == (15, 4)
        notes = resources.get_scene(session, scene.id).declared["notes"]
    assert notes["source"]["up"] == "y" and "m16" not in notes["point_labels"] + notes["controller_labels"]


def test_where_nothing_tells_the_gripper_the_markers_are_drawn_to_be_clicked(
    visit: Visit, tmp_path: Path
) -> None:
    """Names with commas come in a header of their own, as Nexus quotes them; the form separates names by commas."""
    rope = MOTION.points[:, :4]
    labels = ["a,1", "b", "c", "d"]
    lines = [
        ",".join(f'"{label}_{axis}"' for label in ["t", *labels] for axis in ("xyz" if label != "t" else " "))
    ]
    lines[0] = lines[0].replace('"t_ "', "time")
    lines += [
        ",".join(f"{v:.6f}" for v in (t, *frame.ravel())) for t, frame in zip(MOTION.times, rope, strict=True)
    ]
    table = tmp_path / "rope.csv"
    table.write_text("\n".join(lines))
    figure = looked_at(visit, table)
    expect(visit.page.locator("[data-told] li").first).to_contain_text("say which markers hold the body")
    expect(figure.locator("[data-legend]")).to_have_text("body 4gripper 0left out 0")
    click(visit, "a,1")
    expect(row(visit, "gripper")).to_contain_text("a,1")
    expect(figure.locator("[data-legend]")).to_have_text("body 3gripper 1left out 0")
    visit.page.locator("[data-markers]").screenshot(path=tmp_path / "markers.png")
    visit.errors.clear()  # Chromium notes the 422 itself
