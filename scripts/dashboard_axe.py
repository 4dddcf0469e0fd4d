"""``python -m scripts.dashboard_axe [--data FOLDER]``: what axe finds on every page of a filled installation.

The installation is that of the dashboard's pictures: an embedded service with one object of each kind. Each page is
opened in a light and in a dark theme, 360 and 1440 px wide, and held against the rules of WCAG 2.0 to 2.2, A and AA,
and axe's best practice. Prints the number of views and every violation; the exit status says whether there was one.
Needs the extra ``dev`` and a Chromium on this machine.
"""

from __future__ import annotations

import argparse
import tempfile
from importlib.resources import files
from pathlib import Path

from playwright.sync_api import Page

from scripts.make_dashboard_pictures import THEMES, WIDTHS_PX, browser, fill, log_in, pages, service, show

AXE = (files("axe_playwright_python") / "axe.min.js").read_text()
TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
RUN = """async (tags) => {
  const found = await axe.run(document, { runOnly: { type: "tag", values: tags }, resultTypes: ["violations"] });
  return found.violations.map((rule) => rule.id + ": " + rule.nodes.map((node) => node.target.join(" ")).join(", "));
}"""


def main() -> None:
    """Serve, fill, look."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--data", type=Path, default=None, help="data folder of the service (default: temporary)"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="physworld-") as temporary:
        data = options.data or Path(temporary) / "data"
        with service(data) as client:
            fill(client)
            base, key = f"{client.base_url}/dashboard", (data / "api-key").read_text().strip()
            views, found = look(pages(client), base, key)
    print("\n".join(found))
    print(f"{views} views of {views // (len(THEMES) * len(WIDTHS_PX))} pages, {len(found)} violations")
    raise SystemExit(int(bool(found)))


def look(paths: dict[str, str], base: str, key: str) -> tuple[int, list[str]]:
    """Number of views, and what axe says of each that breaks a rule."""
    views, found = 0, list[str]()
    with browser() as opened:
        for theme in THEMES:
            context = opened.new_context(color_scheme=theme)  # type: ignore[arg-type]
            context.set_default_timeout(60_000)
            page = context.new_page()
            for name, path in paths.items():
                for width in WIDTHS_PX:
                    page.set_viewport_size({"width": width, "height": 900})
                    show(page, base + path, refused=name == "upload-refused")
                    found += [f"{name} {theme} {width}: {rule}" for rule in violations(page)]
                    views += 1
                if name == "login":
                    log_in(page, base, key)
            context.close()
    return views, found


def violations(page: Page) -> list[str]:
    """Rules that the page breaks as it is now, with the elements; the pages' policy lets no foreign script in."""
    page.evaluate(AXE)
    rules: list[str] = page.evaluate(RUN, TAGS)
    return rules


if __name__ == "__main__":
    main()
