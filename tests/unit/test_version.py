"""One version everywhere: the two distributions, the code that tells it, the images, the citation and the changelog."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import physworld_client
from physworld_client.transport import USER_AGENT

import physworld
from physworld_services.api.app import VERSION

ROOT = Path(__file__).resolve().parents[2]


def test_everything_that_tells_a_version_tells_the_same() -> None:
    told = {
        str(path): tomllib.loads((ROOT / path).read_text())["project"]["version"]
        for path in ("pyproject.toml", "clients/python/pyproject.toml")
    }
    told |= {"physworld": physworld.__version__, "client": physworld_client.__version__, "API": VERSION}
    told["user agent"] = USER_AGENT.rpartition("/")[2]
    told["citation"] = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[0]
    told["changelog"] = re.findall(r"^## (\d\S+),", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[0]
    images = set(re.findall(r"image: physworld/\w+:(\S+)", (ROOT / "docker-compose.yml").read_text()))
    assert len(images) == 1
    told["images"] = images.pop()
    assert len(set(told.values())) == 1, told


def test_the_newest_changes_have_a_date() -> None:
    newest = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[0]
    assert re.fullmatch(r"\d+\.\d+\.\d+, \d{4}-\d\d-\d\d", newest)
