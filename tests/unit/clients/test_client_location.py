"""``Client()`` finds its service: told, by the environment, or the embedded one that runs on the data folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from physworld_client import AsyncClient, Client
from physworld_client.cli import output, service
from physworld_client.cli.app import app
from physworld_client.errors import PhysWorldError
from typer.testing import CliRunner


@pytest.fixture(autouse=True)
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An environment that names no service."""
    for name in ("PHYSWORLD_URL", "PHYSWORLD_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PHYSWORLD_DATA_DIR", str(tmp_path / "data"))


def embedded(folder: Path) -> None:
    """What an embedded service leaves in its data folder while it runs."""
    (folder / "run").mkdir(parents=True)
    (folder / "api-key").write_text("pw_embedded\n")
    state = {"api_url": "http://127.0.0.1:4711/", "api_key_file": str(folder / "api-key")}
    (folder / "run" / "state.json").write_text(json.dumps(state))


def test_without_any_service_the_client_says_what_to_do() -> None:
    with pytest.raises(
        PhysWorldError, match=r"set PHYSWORLD_URL, or start one on .*data with `physworld up`"
    ):
        Client()


def test_the_embedded_service_is_found_with_its_key(tmp_path: Path) -> None:
    embedded(tmp_path / "data")
    with Client() as client:
        assert client.base_url == "http://127.0.0.1:4711"
        assert client.http.headers["Authorization"] == "Bearer pw_embedded"
        assert client.known_as == str(tmp_path / "data")
        assert repr(client) == "Client('http://127.0.0.1:4711')"


def test_the_environment_counts_before_the_embedded_service_and_a_given_address_before_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    embedded(tmp_path / "data")
    monkeypatch.setenv("PHYSWORLD_URL", "http://far.example:8000")
    monkeypatch.setenv("PHYSWORLD_TOKEN", "pw_far")
    with Client() as client:
        assert client.base_url == "http://far.example:8000"
        assert client.http.headers["Authorization"] == "Bearer pw_far"
    assert AsyncClient("http://given.example").base_url == "http://given.example"


def test_a_data_folder_on_the_command_line_counts_before_the_address_in_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PHYSWORLD_URL", "http://far.example:8000")
    assert service.find(None, None, tmp_path / "empty") is None
    found = service.find(None, None, None)
    assert found is not None and found.url == "http://far.example:8000"


def test_units_in_brackets_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    with output.stdout.capture() as captured:
        output.print_table(("track error [mm]",), [("[mm] 3.1",)])
    assert captured.get().split("\n")[:2] == ["track error [mm]", "[mm] 3.1        "]


def test_the_version_is_an_option_too() -> None:
    asked = CliRunner().invoke(app, ["--version"])
    assert asked.exit_code == 0 and asked.output.strip()
    assert asked.output == CliRunner().invoke(app, ["version"]).output
