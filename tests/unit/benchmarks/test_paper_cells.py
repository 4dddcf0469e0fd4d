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
IMAGES = json.loads((cells.RECORDS / "paper_images.json").read_text())
NOTHING: dict[str, object] = {"recordings": {}}


def recorded() -> dict[str, object]:
    kept = Cells(cells.RECORDS / "paper_tables", None)
    return {key: kept.get(key) for key, _ in plan(list(SCENES))}


def test_every_cell_of_the_paper_is_there_or_has_its_reason() -> None:
    assert sum(len(row.figures) for table in cells.TABLES for row in table.rows) == 114
    found = cells.report(cells.Runs(recorded(), SPRINGS, IMAGES))  # type: ignore[arg-type]
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
    before, after = (
        cells.relation(table, row, "Track", cells.Runs({}, of, NOTHING)) for of in (SPRINGS, changed)
    )
    assert before is not None and after is not None
    assert after[0] == pytest.approx(0.5 * before[0])
    beam = SPRINGS["recordings"]["beam_free_a"]["predictors"]
    changed["recordings"] = {"beam_free_a": SPRINGS["recordings"]["beam_free_a"]}
    alone = cells.relation(table, row, "Track", cells.Runs({}, changed, NOTHING))
    assert alone == (pytest.approx(beam["phystwin"]["track_m"] / beam["twin"]["track_m"]), 1, 1)


def test_pictures_are_related_by_recording_and_a_psnr_by_its_difference() -> None:
    def scores(psnr_db: float, lpips: float | None, iou: float) -> dict[str, object]:
        return {"held_out": {"psnr_db": psnr_db, "ssim": 0.9, "lpips": lpips, "iou": iou}}

    images = {
        "recordings": {
            "beam": {"predictors": {"phystwin": scores(20.0, 0.2, 0.4), "twin": scores(23.0, 0.1, 0.8)}},
            "rope": {"predictors": {"phystwin": scores(21.0, None, 0.9), "twin": scores(20.0, None, 0.9)}},
            "cloth": {"predictors": {"twin": scores(30.0, 0.1, 0.9)}},
        }
    }
    table = cells.TABLES[0]
    row = next(one for one in table.rows if one.ours == "phystwin")
    found = {
        column: cells.relation(table, row, column, cells.Runs({}, NOTHING, images))
        for column in cells.COLUMNS
    }
    assert found["PSNR"] == (pytest.approx(-1.0), 1, 2)
    assert found["LPIPS"] == (pytest.approx(2.0), 1, 1)
    assert found["IoU"] == (pytest.approx(0.5**0.5), 1, 2)
    assert found["Track"] is None
    images["recordings"]["beam"]["predictors"]["phystwin"]["held_out"]["iou"] = 0.0  # type: ignore[index]
    lost = cells.relation(table, row, "IoU", cells.Runs({}, NOTHING, images))
    assert lost is not None and lost[0] == 0.0


def test_a_reference_counts_where_another_row_has_the_column() -> None:
    images = {"recordings": {"beam": {"predictors": {"vmp": {"held_out": {"iou": 0.5}}}, "works": {}}}}
    held = {key: None for key, _ in plan(list(SCENES))}
    for other, count in ((None, 0), ("linear", 2)):
        if other is not None:
            images["recordings"]["beam"]["predictors"][other] = {"held_out": {"iou": 0.4}}  # type: ignore[index]
        for of in images["recordings"]["beam"]["predictors"].values():
            of["held_out"] |= dict.fromkeys(("psnr_db", "ssim", "lpips"))  # type: ignore[union-attr,arg-type]
        found = cells.report(cells.Runs(held, NOTHING, images))  # type: ignore[arg-type]
        assert found.figures["count"] == count


def test_a_network_without_demonstrations_is_related_to_the_twin_of_its_own_run() -> None:
    table = cells.TABLES[0]
    row = next(one for one in table.rows if one.title == "GS-Dynamics")
    work = {"own_steps_per_second": 900.0, "twin_steps_per_second": 300.0}
    images = {
        "recordings": {
            "beam": {
                "predictors": {
                    "recording_no_prior": {"track_m": 0.02, "chamfer_phystwin_m": 0.03},
                    "twin": {"track_m": 0.01, "chamfer_phystwin_m": 0.01},
                },
                "works": {"recording_no_prior": work},
            },
            "rope": {"predictors": {}, "works": {"recording_no_prior": {"reason": "it failed"}}},
        }
    }
    runs = cells.Runs({}, NOTHING, images)
    assert cells.relation(table, row, "Track", runs) == (pytest.approx(2.0), 1, 1)
    assert cells.relation(table, row, "FPS", runs) == (pytest.approx(3.0), 1, 1)


def test_without_a_run_there_is_no_cell() -> None:
    held = {key: None for key, _ in plan(list(SCENES))}
    nothing = cells.report(cells.Runs(held, NOTHING, NOTHING))  # type: ignore[arg-type]
    assert nothing.figures["count"] == 0
    assert nothing.notes[0].startswith("0 of 114 cells")
