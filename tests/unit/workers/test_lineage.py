"""The code's version in a lineage, in an image too, where no distribution of ours is installed."""

from __future__ import annotations

import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from physworld_workers.lineage import code_version


def test_the_version_in_a_lineage_is_the_projects_installed_or_not(
    repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", missing)
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    assert code_version() == f"{project['name']} {project['version']}"
