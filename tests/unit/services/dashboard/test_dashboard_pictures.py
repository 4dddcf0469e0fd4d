"""The pictures of the dashboard: every page has them, in both themes and widths, and they stay small."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from PIL import Image, ImageStat
from starlette.routing import Mount

from physworld_services.dashboard import mount
from physworld_services.stores import Stores
from physworld_storage.database import open_database
from physworld_storage.settings import Settings
from scripts.make_dashboard_pictures import FOLDER, PAGES, TALLEST_PX, THEMES, WIDTHS_PX

PARTS = (
    "/live/",
    "/cloud",
    "/curve",
    "/residuals",
    "/npz",
    "/json",
    "/coverage.svg",
    "/artifacts/",
    "/report",
    "/surface",
    "/ghost",
    "/splat",
    "/export/",
    "/followed.png",
)
ELSEWHERE = {"/fits/*", "/checks/*", "/videos/*", "/videos/*/*"}  # films, or lead to what they belong to
MOST_BYTES = 6_000_000


def shape(path: str) -> str:
    """An address with its variable parts as stars."""
    return re.sub(r"\{[^}]*\}", "*", path)


def addressed(app: Any) -> Iterator[str]:
    """Addresses that answer a GET, those of included routers too."""
    for route in app.routes:
        if (inner := getattr(route, "original_router", None)) is not None:
            yield from addressed(inner)
        elif "GET" in (getattr(route, "methods", None) or ()):
            yield route.path


def test_every_page_has_its_pictures(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    app = FastAPI()
    mount(app, settings, open_database(settings), Stores(settings))
    below = next(route.app for route in app.routes if isinstance(route, Mount) and route.path == "/dashboard")
    addresses = set(addressed(below))
    shown = {re.sub(r"^/start/.*", "/start/*", shape(path)) for path in PAGES.values()}
    pages = {shape(path) for path in addresses if not any(part in path for part in PARTS)}
    assert len(pages) > 20 and pages - ELSEWHERE - shown == set()


def test_pictures_are_there_in_both_themes_and_widths_and_small() -> None:
    wanted = {f"{name}-{theme}-{width}.webp" for name in PAGES for theme in THEMES for width in WIDTHS_PX}
    assert {path.name for path in FOLDER.glob("*.webp")} == wanted
    assert sum(path.stat().st_size for path in FOLDER.glob("*.webp")) < MOST_BYTES
    for name in wanted:
        with Image.open(FOLDER / name) as picture:
            assert picture.width == int(name.split("-")[-1].removesuffix(".webp")), name
            assert 300 < picture.height <= TALLEST_PX, name


def test_the_dark_is_dark_and_the_light_light() -> None:
    for name in PAGES:
        means = []
        for theme in THEMES:
            with Image.open(FOLDER / f"{name}-{theme}-1440.webp") as picture:
                means.append(ImageStat.Stat(picture.convert("L")).mean[0])
        assert means[0] > 180 > 90 > means[1], (name, means)
