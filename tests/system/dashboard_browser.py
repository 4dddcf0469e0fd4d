"""A tab of headless Chromium on the dashboard, and what went wrong in it; the fixtures are in ``conftest``."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field

from playwright.sync_api import Page, expect

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
FLAGS = (
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
READY_MS = 60_000  # software WebGL on a busy machine
expect.set_options(timeout=READY_MS)
WATCH_POLICY = """
window.violations = [];
document.addEventListener("securitypolicyviolation", (event) =>
  window.violations.push(`${event.violatedDirective} ${event.blockedURI}`));
"""


@dataclass
class Visit:
    """A browser tab, and what went wrong in it."""

    page: Page
    base: str
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def open(self, path: str) -> None:
        """Go to a page of the dashboard."""
        self.page.goto(self.base + path)

    def login(self, token: str) -> None:
        """Log in through the form that the present page shows."""
        self.page.fill("#key", token)
        self.page.click("button[type=submit]")
        self.page.wait_for_selector(".top nav")

    def points_shown(self) -> None:
        """Wait until the 3D view has its points."""
        self.page.wait_for_selector("[data-cloud][data-ready]", timeout=READY_MS)
