"""axe finds nothing on any page, light and dark, on a phone and a desk: WCAG 2.0 to 2.2, A and AA, and best practice.

``axe-playwright-python`` carries the rules; they are evaluated through the browser's debugger, since the pages' policy
lets no foreign script in.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import pytest
from dashboard_browser import Visit
from dashboard_world import World

pytestmark = pytest.mark.browser
AXE = (files("axe_playwright_python") / "axe.min.js").read_text()
TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
WIDTHS = (360, 1440)
REFUSED = "a refused upload"
CLIPPED = """() => [...document.querySelectorAll(".top nav a")].filter((link) => {
  const [box, bar] = [link.getBoundingClientRect(), link.parentElement.getBoundingClientRect()];
  return box.left < 0 || box.right > Math.min(innerWidth, bar.right) + 1 || box.width < 1;
}).map((link) => link.textContent)"""
BRIGHT = """() => [...document.querySelectorAll("main img, main video")].filter((picture) =>
  !getComputedStyle(picture).filter.includes("invert")).map((picture) => picture.src)"""
RUN = """async (tags) => {
  const found = await axe.run(document, { runOnly: { type: "tag", values: tags }, resultTypes: ["violations"] });
  return found.violations.map((rule) => [rule.id,
    rule.nodes.map((node) => node.target.join(" ") + ": " + (node.any[0]?.message ?? node.failureSummary))]);
}"""


def pages(world: World) -> list[str]:
    """Every page that the dashboard has."""
    starts = (
        "pipeline",
        "fit",
        "check",
        "trace",
        "dataset",
        "training",
        "assessment",
        "loop",
        "rollout",
        "plan",
        "video",
    )
    return [
        "/",
        f"/jobs/{world.pipeline_id}",
        f"/jobs/{world.failed_id}",
        f"/jobs/{world.running_id}",
        "/scenes",
        f"/scenes/{world.scene_id}",
        "/fits",
        "/traces",
        f"/traces/{world.trace_id}",
        f"/assessments/{world.assessment_id}",
        "/datasets",
        f"/datasets/{world.dataset_id}",
        "/models",
        "/models/chain_swing",
        "/models/chain_swing/1",
        "/models/chain_swing/1/playground",
        "/models/chain_swing/compare",
        "/rollouts",
        f"/rollouts/{world.rollout_id}",
        "/plans",
        f"/plans/{world.plan_id}",
        "/keys",
        "/keys/audit",
        "/sessions",
        "/trackings",
        *(f"/start/{kind}" for kind in starts),
    ]


def violations(visit: Visit) -> list[Any]:
    """What axe says of the page as it is now."""
    visit.page.evaluate(AXE)
    found: list[Any] = visit.page.evaluate(RUN, TAGS)
    return found


def refuse(visit: Visit) -> None:
    """Go to the page that answers a form with a file that is no recording, as a browser without scripts sends it."""
    visit.open("/scenes")
    visit.page.set_input_files("#bundle", {"name": "notes.txt", "mimeType": "text/plain", "buffer": b"none"})
    with visit.page.expect_navigation():
        visit.page.evaluate("HTMLFormElement.prototype.submit.call(document.querySelector('[data-upload]'))")
    visit.page.get_by_role("heading", name="This recording cannot be used").wait_for()


def settle(visit: Visit) -> None:
    """Wait until curves are drawn: their legends are text."""
    for curve in visit.page.locator("[data-curve]").all():
        curve.locator(".legend").wait_for()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_axe_finds_nothing_on_any_page(stranger: Visit, world: World, scheme: str, width: int) -> None:
    stranger.page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
    stranger.page.set_viewport_size({"width": width, "height": 900})
    stranger.open("/login")
    found = {"/login": violations(stranger)}
    stranger.login(world.admin_token)
    for path in [*pages(world), REFUSED]:
        if path == REFUSED:
            refuse(stranger)
        else:
            stranger.open(path)
        settle(stranger)
        found[path] = violations(stranger)
        wide = stranger.page.evaluate("document.documentElement.scrollWidth")
        if wide > width:
            found[path].append(["wider than the window", [str(wide)]])
        hidden = stranger.page.evaluate(CLIPPED)
        if hidden:
            found[path].append(["clipped navigation", hidden])
        bright = stranger.page.evaluate(BRIGHT) if scheme == "dark" else []
        if bright:
            found[path].append(["white in the dark", bright])
    stranger.open("/nothing")
    found["/nothing"] = violations(stranger)
    stranger.errors.clear()  # Chromium notes the 404, and the playground's absent inference service
    told = [f"{path} {rule}: {places}" for path, rules in found.items() for rule, places in rules]
    assert not told, "\n".join(told)


def test_axe_would_find_a_picture_without_words(visit: Visit) -> None:
    """The check itself: a page that is broken on purpose is reported."""
    visit.open("/scenes")
    visit.page.evaluate("document.querySelector('main').append(new Image())")
    assert "image-alt" in [rule for rule, _ in violations(visit)]
    visit.errors.clear()
