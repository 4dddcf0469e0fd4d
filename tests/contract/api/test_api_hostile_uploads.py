"""Uploads that cost out of proportion, and forms that crashed: each is refused in seconds, by a sentence."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import psutil
import pytest
from api_service import Service, assert_problem, bundle, upload
from conftest import MAX_UPLOAD_BYTES

from benchmarks.service.hostile_files.bombs import BOMBS, unzipped, zipped
from benchmarks.service.hostile_files.corpus import sound_bundle
from benchmarks.service.hostile_files.cost import run
from physworld_services.api import parsing

MOST_CPU_S = 5.0
FILES = 55
LARGE = "a directory of three million entries"
"""The only bomb that is a large file, of 141 MB: the run below sends it."""


@pytest.fixture
def spent(service: Service, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[dict[str, float]]]:
    """What the parser says that each upload cost."""
    answers: list[dict[str, float]] = []
    ask = parsing._Parser.ask

    def noted(self: parsing._Parser, request: dict[str, object]) -> dict[str, float]:
        answers.append(ask(self, request))
        return answers[-1]

    monkeypatch.setattr(parsing._Parser, "ask", noted)
    yield answers


@pytest.mark.parametrize("name", sorted(set(BOMBS) - {LARGE}))
def test_a_small_file_that_unfolds_is_refused_at_little_cost(
    client: httpx.Client, spent: list[dict[str, float]], name: str
) -> None:
    data = BOMBS[name].make(bundle("hostile"))
    assert len(data) < MAX_UPLOAD_BYTES
    problem = assert_problem(upload(client, data, BOMBS[name].filename), 422, "scene_invalid")
    assert problem["errors"][0]["msg"]
    assert spent[-1]["cpu_s"] < MOST_CPU_S
    assert spent[-1]["peak_bytes"] < 512 * 2**20


@pytest.mark.parametrize("outcome", sorted(parsing.STOPPED))
def test_what_a_limit_stopped_is_a_refusal_with_its_numbers(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch, outcome: str
) -> None:
    answer = {"outcome": outcome, "cpu_s": 4.2, "peak_bytes": 300 * 2**20}
    monkeypatch.setattr(parsing._Parser, "ask", lambda self, request: answer)
    data = bundle("stopped")
    problem = assert_problem(upload(client, data), 422, "scene_invalid")
    assert f"{len(data)} bytes took 4.2 s of processor time and 300 MiB" in problem["detail"]


def test_a_parser_that_was_killed_is_started_again(service: Service, client: httpx.Client) -> None:
    assert upload(client, bundle("before")).status_code == 201
    me = psutil.Process()
    parsers = [child for child in me.children() if "physworld_services.api.parser_process" in child.cmdline()]
    assert parsers
    for parser in parsers:
        parser.kill()
        parser.wait()
    assert upload(client, bundle("after")).status_code == 201


def test_arrays_of_objects_never_come_to_life(client: httpx.Client) -> None:
    buffer = io.BytesIO()
    np.save(buffer, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    data = zipped({**unzipped(bundle("hostile")), "scene.npz": zipped({"points.npy": buffer.getvalue()})})
    problem = assert_problem(upload(client, data), 422, "scene_invalid")
    assert "never Python objects" in problem["detail"]


def test_a_corpus_of_hostile_files_costs_little_and_leaves_no_trace(tmp_path: Path) -> None:
    """The short form of ``python -m benchmarks.service.hostile_files``: known bombs and five files of each family."""
    ledger = run(FILES, seed=1, folder=tmp_path, bundle=sound_bundle())
    assert ledger["files"] == FILES + len(BOMBS)
    assert (ledger["beyond"], ledger["files_outside"], ledger["errors_of_the_service"]) == ([], [], 0)
    assert ledger["statuses"]["422"] > FILES / 2
