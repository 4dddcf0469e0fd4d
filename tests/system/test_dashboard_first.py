"""Pictures with depth in space before a job is started: ground, axis up, what lies in the boxes, boxes by a click."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import table_pictured
from dashboard_browser import Visit
from playwright.sync_api import Locator, expect
from test_dashboard_accessible import violations

pytestmark = pytest.mark.browser
COLOUR = """at => { const { viewer } = window; viewer.render();
  const gl = viewer.view.renderer.getContext(); const pixel = new Uint8Array(4);
  const [x, y] = viewer.pointer.seenAt(viewer.places[at]);
  const scale = gl.drawingBufferWidth / viewer.canvas.clientWidth;
  gl.readPixels(x * scale, gl.drawingBufferHeight - y * scale, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  return [...pixel].slice(0, 3); }"""
PLACE = """at => { const { viewer } = window; viewer.canvas.scrollIntoView({ block: "center" });
  const { left, top } = viewer.canvas.getBoundingClientRect();
  const [x, y] = viewer.pointer.seenAt(viewer.places[at]); return [left + x, top + y]; }"""


def packed(folder: Path, target: Path) -> Path:
    with zipfile.ZipFile(target, "w") as archive:
        for path in sorted(folder.rglob("*.*")):
            archive.write(path, path.relative_to(folder).as_posix())
    return target


def looked_at(visit: Visit, archive: Path) -> Locator:
    """Give the page pictures; the drawing of their cloud."""
    visit.open("/trackings")
    visit.page.set_input_files("#pictures", archive)
    visit.page.get_by_role("button", name="Look").click()
    figure = visit.page.locator("[data-first]")
    expect(figure).to_have_attribute("data-ready", "true")
    return figure


def fill(visit: Visit, group: str, box: tuple[int, ...]) -> None:
    for corner, value in zip(("Left", "Top", "Right", "Bottom"), box, strict=True):
        visit.page.get_by_role("group", name=group).get_by_label(corner).fill(str(value))


def inside(figure: Locator, name: str) -> int:
    return int((figure.locator(f"[data-inside={name}]").inner_text()).split()[0])


def test_the_first_pictures_are_drawn_in_space_and_boxes_colour_what_lies_in_them(
    visit: Visit, tmp_path: Path
) -> None:
    table_pictured.write(tmp_path / "block")
    figure = looked_at(visit, packed(tmp_path / "block", tmp_path / "block.zip"))
    cloud = json.loads(visit.page.evaluate("JSON.stringify(window.viewer.cloud)"))
    pixels, places = np.array(cloud["pixels"]), np.array(cloud["places_m"])
    block = table_pictured.first()[2][pixels[:, 1], pixels[:, 0]]
    assert cloud["ground_m"] == 0.0 and 4000 < len(places) <= 5000
    expect(figure.locator("[data-scale]")).to_have_text(re.compile("^grid .* on the ground$"))
    expect(figure.locator("[data-how]")).to_contain_text(
        "Up is the normal of the ground in the first picture."
    )
    assert [inside(figure, name) for name in ("object", "patch", "held")] == [0, 0, 0]
    middle = places[block].mean(axis=0) + np.array([0.0, 0.0, 0.03])
    at = int(np.argmin(np.linalg.norm(places - middle, axis=1)))  # a point of the block's upper face
    own = np.array(visit.page.evaluate(COLOUR, at), float)
    assert own @ [1, -0.5, -0.5] > 40, own  # the block is red

    box = table_pictured.block_box()
    fill(visit, "Box of the object", box)
    within = (pixels >= box[:2]).all(axis=1) & (pixels < box[2:]).all(axis=1)
    assert inside(figure, "object") == within.sum() >= block.sum() > 100
    marked = np.array(visit.page.evaluate(COLOUR, at), float)
    assert np.abs(marked - own).max() > 40, (own, marked)
    left = (box[0], box[1], box[0] + 30, box[3])
    fill(visit, "Box of what is held", left)
    held = (pixels >= left[:2]).all(axis=1) & (pixels < left[2:]).all(axis=1)
    assert inside(figure, "held") == held.sum() > 10
    schemes: tuple[tuple[Literal["dark", "light"], int], ...] = (("dark", 360), ("light", 1280))
    for scheme, width in schemes:
        visit.page.emulate_media(color_scheme=scheme)
        visit.page.set_viewport_size({"width": width, "height": 900})
        assert violations(visit) == []
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= width
    figure.screenshot(path=tmp_path / "first.png")

    # the arrow named z stands on the ground and points up in the picture
    foot, tip = visit.page.evaluate(
        "(() => { const { viewer } = window; const low = viewer.tip.clone().setZ(0);"
        " return [viewer.pointer.seenAt(low), viewer.pointer.seenAt(viewer.tip)]; })()"
    )
    assert tip[1] < foot[1] - 50 and abs(tip[0] - foot[0]) < 2
    with visit.page.expect_response(re.compile(r"/trackings/preview$")):
        visit.page.locator("select[data-option=up]").select_option("-y")
    expect(figure.locator("[data-how]")).to_contain_text("Up is -y of the cameras' world, given.")
    assert inside(figure, "object") == within.sum()  # boxes stay
    expect(figure.locator("[data-scale]")).to_contain_text("no ground is seen")


def test_a_click_on_a_point_puts_the_chosen_box_around_it(visit: Visit, tmp_path: Path) -> None:
    table_pictured.write(tmp_path / "block")
    figure = looked_at(visit, packed(tmp_path / "block", tmp_path / "block.zip"))
    pixels = np.array(visit.page.evaluate("window.viewer.cloud.pixels"))
    box = table_pictured.block_box()
    wanted = ((box[0] + box[2]) // 2, box[1] + 6)  # on the block's upper face
    at = int(np.argmin(np.linalg.norm(pixels - wanted, axis=1)))

    def corners(name: str) -> list[int]:
        return [
            int(one.input_value()) for one in visit.page.locator(f"[data-box={name}] [data-corner]").all()
        ]

    visit.page.mouse.click(*visit.page.evaluate(PLACE, at))
    middle = np.array(corners("object")).reshape(2, 2).mean(axis=0)
    assert (
        np.abs(middle - pixels[at]).max() <= 5 and inside(figure, "object") > 100
    )  # a neighbour may be nearer
    fill(visit, "Box of the object", box)
    visit.page.mouse.click(*visit.page.evaluate(PLACE, at))
    moved = corners("object")
    assert [moved[2] - moved[0], moved[3] - moved[1]] == [box[2] - box[0], box[3] - box[1]]
    visit.page.get_by_role("radio", name="draw or click it by mouse").check()
    visit.page.mouse.click(*visit.page.evaluate(PLACE, at))
    expect(visit.page.get_by_label("What moves the object")).to_have_value("patch")
    patch = corners("patch")
    assert [patch[2] - patch[0], patch[3] - patch[1]] == [40, 40] and inside(figure, "patch") > 20


def test_depth_that_cannot_be_read_leaves_the_picture_to_draw_on(visit: Visit, tmp_path: Path) -> None:
    table_pictured.write(tmp_path / "block")
    (tmp_path / "block/depth/0.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    visit.open("/trackings")
    visit.page.set_input_files("#pictures", packed(tmp_path / "block", tmp_path / "block.zip"))
    visit.page.get_by_role("button", name="Look").click()
    expect(visit.page.locator("[data-unclouded]")).to_contain_text(
        "The depth is not shown: 0.png: is no picture"
    )
    expect(visit.page.locator("[data-first]")).to_be_hidden()
    expect(visit.page.get_by_role("img", name="First picture of the camera, with the boxes")).to_be_visible()
