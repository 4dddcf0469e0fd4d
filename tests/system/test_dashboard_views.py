"""The pages' 3D views as pictures: points have their colours, and all of them are seen on a phone as well."""

from __future__ import annotations

import re

import numpy as np
import pytest
from dashboard_browser import Visit
from dashboard_world import World
from playwright.sync_api import Page, expect

from physworld_services.dashboard.clouds import Cloud, Layer

pytestmark = pytest.mark.browser
DARK = 190
"""Brightness, of 255, under which a pixel is neither the light theme's background nor its grid."""
OVER = "for (const over of document.querySelectorAll('.stage3d > :not(canvas)')) over.style.visibility = "
"""Script that hides or shows what is written over the picture."""


def test_small_particles_are_as_dark_as_their_role(visit: Visit, world: World) -> None:
    visit.page.emulate_media(color_scheme="light")
    visit.open(f"/datasets/{world.dataset_id}")
    visit.points_shown()
    visit.page.locator("[data-legend] label", has_text="Controllers").locator("input").uncheck()
    assert len(dark_columns(visit.page)) > 20
    visit.page.locator("[data-legend] label", has_text="Particles").locator("input").uncheck()
    assert dark_columns(visit.page) == []


@pytest.mark.parametrize("width", [1440, 360])
def test_the_corners_of_a_body_are_in_the_picture(visit: Visit, world: World, width: int) -> None:
    show_square(visit, world)
    visit.page.set_viewport_size({"width": width, "height": 900})
    visit.open(f"/scenes/{world.scene_id}")
    visit.points_shown()
    assert_inside(visit.page)


def test_a_view_that_becomes_narrow_still_shows_every_point(visit: Visit, world: World) -> None:
    show_square(visit, world)
    visit.open(f"/scenes/{world.scene_id}")
    visit.points_shown()
    visit.page.set_viewport_size({"width": 360, "height": 900})
    expect(visit.page.locator("figure canvas")).to_have_attribute("width", re.compile("^3[0-5].$"))
    assert_inside(visit.page)


def show_square(visit: Visit, world: World) -> None:
    """The view of the scene has the four corners of a square instead of the recording."""
    corners = np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)], dtype="<f4")
    layer = Layer("measured", "Measured", "measured", corners[None])
    described = Cloud(np.zeros(1), [layer]).describe("/dashboard/square")
    visit.page.emulate_media(color_scheme="light")
    visit.page.route(f"**/scenes/{world.scene_id}/cloud*", lambda route: route.fulfill(json=described))
    visit.page.route("**/square/measured", lambda route: route.fulfill(body=layer.buffer()))


def assert_inside(page: Page) -> None:
    """All four points are in the picture, beside each other, and none lies at a side."""
    width = page.locator("figure canvas").evaluate("canvas => canvas.clientWidth")
    columns = sorted(dark_columns(page))
    assert 1 + np.count_nonzero(np.diff(columns) > 1) == 4
    assert 3 < columns[0] < columns[-1] < width - 4


def dark_columns(page: Page) -> list[int]:
    """Columns of the view's picture that hold a dark pixel. The browser decodes it."""
    page.evaluate(f"() => {{ {OVER} 'hidden' }}")
    picture = page.locator("figure canvas").screenshot()
    page.evaluate(f"() => {{ {OVER} '' }}")
    found: list[int] = page.evaluate(
        """async ([bytes, dark]) => {
          const image = await createImageBitmap(new Blob([new Uint8Array(bytes)], { type: "image/png" }));
          const canvas = new OffscreenCanvas(image.width, image.height);
          const context = canvas.getContext("2d");
          context.drawImage(image, 0, 0);
          const { data } = context.getImageData(0, 0, image.width, image.height);
          const columns = new Set();
          for (let i = 0; i < data.length; i += 4) {
            if ((data[i] + data[i + 1] + data[i + 2]) / 3 < dark) columns.add((i / 4) % image.width);
          }
          return [...columns];
        }""",
        [list(picture), DARK],
    )
    return found
