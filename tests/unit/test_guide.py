"""The guide: built strictly and without a network, self-contained, served under its address, and true to the code."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from serving import serve

from physworld_services import guide
from physworld_services.dashboard.site import environment_of_pages
from physworld_services.web import create_app
from physworld_storage.settings import Settings
from scripts.guide_pages import notebook_page, with_films, with_links, with_lists
from scripts.make_reference import pages

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
OFFLINE = """
import socket, sys
def refused(*_):
    raise OSError("the build of the guide asked for the network")
socket.socket.connect = socket.getaddrinfo = refused
from mkdocs.__main__ import cli
cli(["build", "--strict", "--clean", "--site-dir", sys.argv[1]])
"""
LOADED = re.compile(
    r"""<(?:script|img|iframe|source)\b[^>]*?\bsrc=["']?([^"'\s>]+)|<link\b[^>]*?\bhref=["']?([^"'\s>]+)"""
)
IN_STYLE = re.compile(r"url\(([^)]+)\)|@import\s+([^;]+)")
SOURCES = ("physworld", "scenes", "schemas", "storage", "workers", "services", "clients", "scripts")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The guide, built."""
    folder = tmp_path_factory.mktemp("guide")
    command = [sys.executable, "-c", OFFLINE, str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_a_page_loads_nothing_from_another_server(site: Path) -> None:
    html = sorted(site.rglob("*.html"))
    assert len(html) > 60
    loaded = {a or b for page in html for a, b in LOADED.findall(page.read_text())}
    loaded |= {
        (a or b).strip("\"'") for sheet in site.rglob("*.css") for a, b in IN_STYLE.findall(sheet.read_text())
    }
    assert loaded and {address for address in loaded if re.match(r"(https?:)?//", address)} == set()
    for word in ("googletagmanager", "google-analytics", "fonts.googleapis"):
        assert not [page.name for page in html if word in page.read_text()]


def test_decisions_are_in_the_guide_but_not_in_its_navigation(site: Path) -> None:
    assert (site / "adr" / "0034-dependencies-by-digest.html").is_file()
    start = (site / "index.html").read_text()
    navigation = start[start.index("<nav") : start.index("<article")]
    assert "adr/index.html" in navigation and "adr/0034" not in navigation


def test_every_page_is_in_the_guide(site: Path) -> None:
    sources = [page.relative_to(ROOT / "docs") for page in (ROOT / "docs").rglob("*.md")]
    missing = [page for page in sources if not (site / page.with_suffix(".html")).is_file()]
    assert [page for page in missing if page.name != "README.md"] == []  # a README may become an index


def test_the_web_process_serves_it_with_a_policy_that_its_scripts_pass(site: Path) -> None:
    app = FastAPI()
    guide.mount(app, site)
    with serve(app) as url, httpx.Client(base_url=url, trust_env=False) as client:
        assert client.get("/docs/guide").headers["location"] == "/docs/guide/"
        start = client.get("/docs/guide/")
        assert start.status_code == 200 and "PhysWorld" in start.text
        policy = start.headers["content-security-policy"]
        inline = re.findall(r"<script>", start.text)
        scripts = policy.split("script-src")[1].split(";")[0]
        assert inline and scripts.count("sha256-") == len(inline) and "unsafe-inline" not in scripts
        assert client.get("/docs/guide/howto/optitrack.html").status_code == 200
        assert client.get("/docs/guide/nothing.html").status_code == 404
        assert client.get("/docs/guide/%2e%2e/%2e%2e/pyproject.toml").status_code == 404


def test_without_a_built_guide_the_answer_says_what_to_do(site: Path, tmp_path: Path) -> None:
    app = FastAPI()
    guide.mount(app, tmp_path / "site")
    with serve(app) as url, httpx.Client(base_url=url, trust_env=False) as client:
        absent = client.get("/docs/guide/")
        assert absent.status_code == 404 and "make docs" in absent.text
        shutil.copytree(site, tmp_path / "site")
        assert client.get("/docs/guide/").status_code == 200  # without a restart


def test_the_service_has_the_route_and_the_dashboard_the_link_where_it_is_built(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = create_app(Settings(data_dir=tmp_path))
    assert "/docs/guide" in {getattr(route, "path", None) for route in app.routes}
    head = environment_of_pages().get_template("base.html")
    links = []
    for folder in (site, tmp_path / "nothing"):
        monkeypatch.setattr(guide, "SITE", folder)
        links.append(f'href="{guide.BASE}/"' in head.render(viewer="me", may_manage=False, title="Jobs"))
    assert links == [True, False]


def test_make_up_builds_the_guide_where_there_is_none(tmp_path: Path) -> None:
    def planned() -> str:
        command = ["make", "--dry-run", "up", f"SITE={tmp_path}"]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout

    steps = planned().splitlines()
    (build,) = [number for number, line in enumerate(steps) if "mkdocs build" in line]
    (start,) = [number for number, line in enumerate(steps) if "physworld up" in line]
    assert build < start and str(tmp_path) in steps[build]
    target = ["make", "--silent", f"{tmp_path}/index.html", f"SITE={tmp_path}", "--assume-old=install"]
    subprocess.run(target, cwd=ROOT, check=True)
    assert guide.is_built(tmp_path)
    assert "mkdocs" not in planned()


def test_the_reference_pages_are_what_the_code_says() -> None:
    stale = [path.name for path, text in pages().items() if path.read_text() != text]
    assert stale == [], "run `make reference`"


def test_troubleshooting_quotes_messages_that_the_code_prints() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    headings = re.findall(r"^### (.*)$", page, re.MULTILINE)
    quoted = [
        part.strip()
        for line in headings
        for text in re.findall(r"`([^`]+)`", line)
        for part in text.split("…")
    ]
    files = [path for name in SOURCES for end in ("py", "sh") for path in (ROOT / name).rglob(f"*.{end}")]
    # literals that Python joins are joined here too
    code = re.sub(r"\"\s*\n\s*f?\"", "", "\n".join(path.read_text() for path in files))
    assert len(quoted) > 25
    assert [part for part in quoted if part not in code] == []


def test_links_out_of_docs_lead_to_their_pages() -> None:
    assert with_links("[a](../CONTRIBUTING.md#style)", "index.md") == "[a](project/contributing.md#style)"
    assert with_links("[a](../../CONTRIBUTING.md)", "howto/x.md") == "[a](../project/contributing.md)"
    assert with_links("[a](docs/scenes.md)", "project/changes.md") == "[a](../scenes.md)"
    assert with_links("[a\nb](x.ipynb)", "notebooks/y.md") == "[a\nb](x.md)"
    assert with_links("`[a](../LICENSE)` [a](../LICENSE)", "index.md") == "`[a](../LICENSE)` a"


def test_a_picture_that_leads_to_a_film_becomes_a_player(site: Path) -> None:
    player = with_films("a [![b](c.webp)](d.mp4) [![b](c.webp)](d.html)")
    assert player.startswith("a <video controls ") and player.endswith(" [![b](c.webp)](d.html)")
    assert 'aria-label="b"' in player and 'poster="c.webp"' in player and 'src="d.mp4"' in player
    films = re.findall(r'<video [^>]*poster="([^"]+)" src="([^"]+)"', (site / "gallery.html").read_text())
    assert len(films) == 6 and all((site / part).is_file() for film in films for part in film)


def test_a_list_below_a_paragraph_is_a_list() -> None:
    assert with_lists("a:\n- b\n- c") == "a:\n\n- b\n- c"
    assert with_lists("```\na:\n- b\n```") == "```\na:\n- b\n```"


def test_a_notebook_becomes_a_page_with_its_outputs() -> None:
    cells = [
        {"cell_type": "markdown", "source": ["# A"]},
        {"cell_type": "code", "source": ["1 + 1"], "outputs": [{"data": {"text/plain": ["2"]}}]},
    ]
    page = notebook_page({"cells": cells}, "a.ipynb")
    assert page == "# A\n\n```python\n1 + 1\n```\n\n```text\n2\n```\n\n[Download a.ipynb](a.ipynb)\n"
