"""Hostile files and their ledger: a file follows from its number alone, bombs are whole, traces are seen."""

from __future__ import annotations

import copy
import io
import json
import struct
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from benchmarks.service.hostile_files import bombs
from benchmarks.service.hostile_files.__main__ import main
from benchmarks.service.hostile_files.corpus import Corpus, sound_bundle
from benchmarks.service.hostile_files.cost import Meter
from benchmarks.service.hostile_files.ledger import MOST_BYTES, Cost, Ledger
from benchmarks.service.hostile_files.pieces import CANARY, VALUES, value
from benchmarks.service.hostile_files.traces import Traces
from benchmarks.service.web_process import WebProcess, serving
from physworld_services.api.parser_process import MEMORY_BYTES

pytestmark = pytest.mark.slow

BUNDLE = sound_bundle()
DECLARATIONS = range(2, 11 * 250, 11)


def test_a_value_may_be_written_into() -> None:
    before, rng = copy.deepcopy(VALUES), np.random.default_rng(0)
    for _ in range(500):
        made = value(rng)
        if isinstance(made, list):
            made.append(made)
        elif isinstance(made, dict):
            made["more"] = made
    assert repr(VALUES) == repr(before)


def test_a_file_does_not_depend_on_those_made_before(tmp_path: Path) -> None:
    """Forwards, then backwards: with values that are shared, file 2 made last is another than file 2 made first."""
    corpus = Corpus(tmp_path, BUNDLE)
    numbers = [*DECLARATIONS, *range(1000, 1009), *range(2000, 2008)]
    forwards = {number: corpus.file(number) for number in numbers}
    again = Corpus(tmp_path, BUNDLE)
    assert {number: again.file(number) for number in reversed(numbers)} == forwards


def test_compressed_tars_do_not_hold_the_time_of_day(tmp_path: Path) -> None:
    corpus = Corpus(tmp_path, BUNDLE)
    tars = [corpus.file(number).content for number in range(6, 11 * 40, 11)]
    packed = [tar for tar in tars if tar[:2] == b"\x1f\x8b"]
    assert packed and {tar[4:8] for tar in packed} == {bytes(4)}


def test_every_known_bomb_is_sent_whole(tmp_path: Path) -> None:
    sent = {bomb.family: bomb for bomb in Corpus(tmp_path, BUNDLE).known()}
    assert list(sent) == list(bombs.BOMBS)
    assert sent["lists that share one child"].filename.endswith(".pkl")
    assert sent["a length of 60,000 digits"].filename.endswith(".tar")
    assert sent["a length of 60,000 digits"].content.count(b"1" * 60_000) == 1
    lists = zipfile.ZipFile(io.BytesIO(sent["five million lists under an unknown key"].content))
    assert lists.getinfo("scene.json").file_size > 15_000_000
    assert len(sent["a directory of three million entries"].content) > 3_000_000 * 46


def test_a_directory_holds_as_many_entries_as_it_is_said_to() -> None:
    data = bombs.huge_directory(70_000)
    place, found = data.index(b"PK\x01\x02"), 0
    while data[place : place + 4] == b"PK\x01\x02":
        (length,) = struct.unpack_from("<H", data, place + 28)
        place, found = place + 46 + length, found + 1
    assert found == 70_000 and data[place : place + 4] == b"PK\x05\x06"


def _log(path: Path, *events: dict[str, object]) -> None:
    with path.open("a") as log:
        log.writelines(json.dumps(event) + "\n" for event in events)


def test_a_reader_whose_end_nobody_saw_counts_with_its_limit(tmp_path: Path) -> None:
    with serving(tmp_path) as web:
        log = tmp_path / "told.log"
        log.touch()
        meter = Meter(WebProcess(web.url, web.token, web.pid, log))
        try:
            assert meter.reader_peak(413, 1000) == 0  # refused before any reader was asked
            assert meter.reader_peak(0, 1000) >= MEMORY_BYTES
            assert meter.reader_peak(500, 1000) >= MEMORY_BYTES
            _log(log, {"event": "upload_read", "peak_bytes": 17 * 2**20})
            assert meter.reader_peak(422, 1000) == 17 * 2**20
            _log(log, {"event": "parser_gone", "status": -9})
            assert meter.reader_peak(422, 1000) >= MEMORY_BYTES
        finally:
            meter.close()


def test_traces_are_found_at_any_depth(tmp_path: Path) -> None:
    data, working = tmp_path / "run" / "data", tmp_path / "working"
    deep = working / "some" / "folder"
    for folder in (data, deep, working / ".git"):
        folder.mkdir(parents=True)
    (deep / "there").write_text("before")
    (deep / "goes").touch()
    traces = Traces(data, [working])
    assert traces.since() == []
    (data / "physworld.db").touch()
    (working / ".git" / "index").touch()
    assert traces.since() == []
    (deep / "there").write_text("overwritten")
    (deep / "goes").unlink()
    (data.parent / "temporary").mkdir()
    (data.parent / "temporary" / "left").touch()
    (data / CANARY).touch()
    expected = [deep / "there", deep / "goes", data.parent / "temporary", data.parent / "temporary/left"]
    assert traces.since() == sorted(str(path) for path in (*expected, data / CANARY))


def test_a_ledger_counts_what_broke_a_limit() -> None:
    ledger = Ledger(0, 3)
    ledger.add(0, "zip", 10, Cost(422, 0.1, 2**20, 0.1))
    ledger.add(None, "two million edges", 10, Cost(0, 0.1, 2**20, 0.1))
    for number in range(30):
        ledger.add(number, "zip", 10, Cost(422, 0.1, MOST_BYTES + 1, 0.1))
    report = ledger.report()
    assert report["files_beyond"] == 31 and len(report["beyond"]) == 20
    assert report["files"] == 32 and report["errors_of_the_service"] == 1
    assert "| zip | 31 | 0.10 | 512 | 422: 31 |" in ledger.table().markdown()


def test_a_run_that_breaks_off_leaves_its_ledger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The corpus has no file of number -1: numpy refuses the seed, after the known bombs have been sent."""
    kept = tmp_path / "ledger.json"
    monkeypatch.setattr(sys, "argv", ["hostile_files", "--count=1", "--first=-1", f"--json={kept}"])
    with pytest.raises(ValueError):
        main()
    ledger = json.loads(kept.read_text())
    assert set(ledger["families"]) == set(bombs.BOMBS)
    assert (ledger["beyond"], ledger["errors_of_the_service"]) == ([], 0)
