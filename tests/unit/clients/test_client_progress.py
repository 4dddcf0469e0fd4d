"""Bars of transfers: how far they come, that retries begin again, and that nothing is shown without a terminal."""

from __future__ import annotations

import hashlib
import io
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest
from physworld_client import Client, progress
from physworld_client.bundle import Upload
from physworld_client.progress import Bars

DATA = bytes(range(200)) * 50
DIGEST = hashlib.sha256(DATA).hexdigest()


class Display:
    """What a bar tells its display, in order; in place of rich's."""

    def __init__(self) -> None:
        self.told: list[Any] = []
        self.done = 0.0

    def start(self) -> None:
        self.told.append("start")

    def stop(self) -> None:
        self.told.append("stop")

    def add_task(self, name: str, total: float | None) -> int:
        self.told.append((name, total))
        return 1

    def remove_task(self, task: int) -> None:
        self.told.append(("gone", self.done))

    def update(
        self, task: int, completed: float | None = None, advance: float = 0, total: float | None = None
    ) -> None:
        self.done = (self.done if completed is None else completed) + advance
        if total is not None:
            self.told.append(("total", total))


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch) -> Display:
    made = Display()
    monkeypatch.setattr(progress, "_display", lambda: made)
    return made


def client(handler: Any, shown: bool | None) -> Client:
    return Client("http://127.0.0.1:1", "key", transport=httpx.MockTransport(handler), progress=shown)


def test_a_download_moves_its_bar_to_the_end(display: Display, tmp_path: Path) -> None:
    with client(lambda request: httpx.Response(200, content=DATA), True) as connected:
        connected.artifacts.download(DIGEST, tmp_path / "file.bin")
    assert display.told == ["start", ("file.bin", None), ("total", len(DATA)), ("gone", len(DATA)), "stop"]


def test_an_upload_moves_its_bar_as_it_is_read_and_begins_again_with_a_retry(display: Display) -> None:
    upload = Upload(io.BytesIO(DATA), "beam.zip", "application/zip")
    with Bars(True).sending(upload) as sent:
        assert sent.stream.read(100) == DATA[:100]
        assert display.done == 100
        sent.stream.seek(0)
        assert display.done == 0
        assert sent.stream.read() == DATA
    assert display.told == ["start", ("beam.zip", len(DATA)), ("gone", len(DATA)), "stop"]


def test_two_transfers_share_one_display(display: Display) -> None:
    bars = Bars(True)
    with bars.receiving("a"), bars.receiving("b"):
        pass
    assert [entry for entry in display.told if isinstance(entry, str)] == ["start", "stop"]


def test_nothing_is_shown_where_there_is_no_terminal(display: Display, tmp_path: Path) -> None:
    assert not sys.stderr.isatty()
    with client(lambda request: httpx.Response(200, content=DATA), None) as connected:
        connected.artifacts.download(DIGEST, tmp_path / "file.bin")
    assert display.told == []


def test_the_real_display_draws_on_the_standard_error_stream(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with client(lambda request: httpx.Response(200, content=DATA), True) as connected:
        connected.artifacts.download(DIGEST, tmp_path / "file.bin")
    shown = capsys.readouterr()
    assert "file.bin" in shown.err
    assert shown.out == ""
