"""The paper's tables cell by cell: all 114 are accounted for, and relations are those of one run."""

from __future__ import annotations

import copy
import json
import re

import pytest

from benchmarks.paper import cells
from benchmarks.paper.models import SCENES
from benchmarks.paper.tables import Cells, plan

SPRINGS = json.loads((cells.RECORDS / "measured_springs.json").read_text())


def recorded() -> dict[str, object]:
    kept = Cells(cells.RECORDS / "paper_tables", None)
    return {key: kept.get(key) for key, _ in plan(list(SCENES))}


def test_every_cell_of_the_paper_is_there_or_has_its_reason() -> None:
    assert sum(len(row.figures) for table in cells.TABLES for row in table.rows) == 114
    found = cells.report(recorded(), SPRINGS)  # type: ignore[arg-type]
    assert found.figures["total"] == 114
    assert found.figures["count"] == len(found.figures["cells"])
    missing = [
        int(n) for note in found.notes if "Not there" in note for n in re.findall(r"(\d+) cells of", note)
    ]
    assert found.figures["count"] + sum(missing) == 114


def test_a_network_is_related_to_the_twin_of_its_own_run() -> None:
    table = cells.TABLES[0]
    row = next(one for one in table.rows if one.ours == "phystwin")
    changed = copy.deepcopy(SPRINGS)
    for recording in changed["recordings"].values():
        recording["predictors"]["twin"]["track_m"] *= 2.0
    before, after = (cells.relation(table, row, "Track", {}, of) for of in (SPRINGS, changed))
    assert before is not None and after is not None
    assert after[0] == pytest.approx(0.5 * before[0])
    beam = SPRINGS["recordings"]["beam_free_a"]["predictors"]
    changed["recordings"] = {"beam_free_a": SPRINGS["recordings"]["beam_free_a"]}
    alone = cells.relation(table, row, "Track", {}, changed)
    assert alone == (pytest.approx(beam["phystwin"]["track_m"] / beam["twin"]["track_m"]), 1, 1)


def test_without_a_run_there_is_no_cell() -> None:
    nothing = cells.report({key: None for key, _ in plan(list(SCENES))}, {"recordings": {}})
    assert nothing.figures["count"] == 0
    assert nothing.notes[0].startswith("0 of 114 cells")
