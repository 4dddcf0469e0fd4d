"""The paper's tables: cells that are kept, relations over scenes and seeds, a report of what is there."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_scene import made_scene

from benchmarks.paper import tables as paper_tables
from benchmarks.paper import unseen_motion
from benchmarks.paper.models import filled_in
from benchmarks.paper.relations import ALONE, CONDITIONS, RELATIONS, SEEDS, Relation, hold
from benchmarks.paper.tables import Cells, plan, summarise


def cell(model: float, tuned: float, twin: float = 0.002) -> dict[str, Any]:
    errors = {"static": 0.1, "rigid_follow": 0.02, "constant_velocity": 0.5, "twin": twin}
    errors |= {"world_model": model, "world_model_finetuned": tuned}
    speeds = {"steps_per_second": {"world_model": 800.0, "twin": 20.0}}
    return {metric: dict(errors) for metric in paper_tables.METRICS} | speeds


def held(scenes: list[str]) -> dict[str, dict[str, Any] | None]:
    """Everything of the first two seeds; the third one is not done."""
    found: dict[str, dict[str, Any] | None] = {key: None for key, _ in plan(scenes)}
    worse = {"full": 1.0, "vmp": 1.5, "linear": 3.0, "none": 1.0 / 1.1, "uniform": 1.2, "random": 1.4}
    for scene in scenes:
        for seed in SEEDS[:2]:
            for condition, factor in worse.items():
                found[f"{scene}/{condition}/{seed}"] = cell(
                    0.005 * factor, 0.004 * factor * (1.0 + 0.1 * seed)
                )
            found[f"{scene}/{ALONE}/{seed}"] = {metric: {ALONE: 0.016} for metric in paper_tables.METRICS}
    return found


def test_every_relation_of_the_paper_is_planned_for_every_scene_and_seed() -> None:
    keys = [key for key, _ in plan(["soft_beam", "d02"])]
    assert len(keys) == len(set(keys)) == len(SEEDS) * (2 * (len(CONDITIONS) + 1) + 1)
    first = [key for key in keys if key.endswith("/0")]
    assert keys[: len(first)] == first, "a whole seed comes before the next one"


def test_a_relation_is_judged_pair_by_pair() -> None:
    report = summarise(["soft_beam"], held(["soft_beam"]))
    relations = report.figures["relations"]
    assert relations["vmp_against_linear"]["mean_ratio"] == pytest.approx(0.5)
    assert (relations["vmp_against_linear"]["holds_in"], relations["vmp_against_linear"]["pairs"]) == (2, 2)
    assert relations["p3_against_none"]["mean_ratio"] == pytest.approx(1.1)
    assert relations["p3_against_none"]["holds_in"] == 0
    assert not relations["p3_against_none"]["by_scene"]["soft_beam"]["holds"]
    assert relations["finetuned_against_twin"]["by_scene"]["soft_beam"]["by_seed"]["0"] == pytest.approx(2.0)
    assert report.figures["cells"]["done"] == 14
    assert f"14 of {len(held(['soft_beam']))} cells are done" in report.markdown()
    assert report.figures["steps_per_second"]["soft_beam"]["ratio"] == pytest.approx(40.0)


def test_a_report_without_a_cell_says_that_nothing_was_measured() -> None:
    report = summarise(["soft_beam"], {key: None for key, _ in plan(["soft_beam"])})
    assert report.rows == []
    assert report.markdown().count("not measured yet") == len(RELATIONS)
    empty = hold(Relation("x", "twin", "static", ""), report.figures["errors"])
    assert empty["pairs"] == 0 and empty["mean_ratio"] is None


def test_a_section_of_some_cells_says_what_was_not_run() -> None:
    """Rows and relations of what is there, beside the names of what is not."""
    some = held(["soft_beam", "d02"])
    some |= {key: None for key in some if key.startswith("d02/")}
    report = summarise(["soft_beam", "d02"], some)
    text = report.markdown()
    assert [row[2:] for row in report.rows if "no prior" in row[1]] == [["not run"] * 3]
    assert not any("d02" in row[0] for row in report.rows)
    assert "(2 of 3 seeds)" in next(row[2] for row in report.rows if row[1] == "twin")
    for words in (
        "Not run: soft_beam/unseen_motion; soft_beam/no_prior; d02/full;",
        "; soft_beam/full (seed 2); ",
        "d02/full;",
        "d02/recording_alone;",
        "the network alone, no prior (400 steps): not measured yet.",
        "track error ratio 0.50 (soft_beam 0.50, d02 not run)",
    ):
        assert words in text
    whole = {key: cell(0.005, 0.004) for key in some if "unseen" not in key}
    assert paper_tables.not_run(whole) == "All were run."


def test_a_model_that_left_the_numbers_is_counted_and_not_averaged() -> None:
    some = held(["soft_beam"])
    lost = cell(0.005, 0.004)
    for metric in paper_tables.METRICS:
        del lost[metric]["world_model_finetuned"]
    some |= {"soft_beam/no_prior/0": cell(0.02, 0.02), "soft_beam/no_prior/1": lost}
    report = summarise(["soft_beam"], some)
    row = next(row for row in report.rows if "no prior" in row[1])
    assert row[2] == "20 (2 of 3 seeds) (1 of 2 left the numbers)"
    alone = report.figures["relations"]["network_alone_against_twin"]
    assert alone["pairs"] == 1 and alone["mean_ratio"] == pytest.approx(10.0)
    assert report.figures["steps_per_second"]["soft_beam"] == {
        "world_model": 800.0,
        "twin": 20.0,
        "ratio": 40.0,
    }


def test_cells_of_the_network_alone_depend_on_its_own_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Cells, "case", lambda self, name: name)
    for key in ("soft_beam/full/0", "soft_beam/no_prior/0"):
        Cells(tmp_path, None).fill(key, lambda case: {})
    longer = dataclasses.replace(paper_tables.WITHOUT_PRIOR, steps=7)
    monkeypatch.setitem(paper_tables.TRAININGS, "no_prior", longer)
    assert Cells(tmp_path, None).get("soft_beam/no_prior/0") is None
    assert Cells(tmp_path, None).get("soft_beam/full/0") is not None


def test_a_finished_cell_is_not_done_again_and_no_cell_begins_after_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Cells, "case", lambda self, name: name)
    cells = Cells(tmp_path, None)
    done: list[str] = []

    def work(case: Any) -> dict[str, Any]:
        done.append(case)
        return {"error": 0.5}

    cells.fill("soft_beam/full/0", work)
    Cells(tmp_path, None).fill("soft_beam/full/0", work)
    assert done == ["soft_beam"]
    assert Cells(tmp_path, None).get("soft_beam/full/0")["error"] == 0.5  # type: ignore[index]
    late = Cells(tmp_path, 0.0)
    late.fill("d02/full/0", work)
    assert late.get("d02/full/0") is None and done == ["soft_beam"]
    monkeypatch.setattr(paper_tables, "settings", lambda: {"episodes": 1})
    assert Cells(tmp_path, None).get("soft_beam/full/0") is None, "cells of other settings do not count"


def test_unseen_motions_are_pooled_over_seeds() -> None:
    def one(error: float) -> dict[str, Any]:
        figures = {"mean_m": error, "largest_m": 3 * error, "at_frame_m": {"10": error, "100": 2 * error}}
        return {
            "size_m": 0.2,
            "unseen": figures,
            "seen": figures,
            "baselines": dict.fromkeys(("static", "rigid_follow"), figures),
        }

    found = unseen_motion.pooled([one(0.001), None, one(0.003)])
    assert found is not None and found["seeds"] == 2
    assert found["unseen"]["mean_m"]["mean"] == pytest.approx(0.002)
    assert found["unseen"]["at_frame_m"]["100"] == pytest.approx(0.004)
    assert "trained without it 2.00" in unseen_motion.in_words("twist", found)
    assert unseen_motion.pooled([None]) is None


def test_the_twin_and_the_baselines_stand_in_the_cells_of_every_condition() -> None:
    some = {key: None for key, _ in plan(["soft_beam"])} | {"soft_beam/no_prior/1": cell(0.02, 0.02)}
    report = summarise(["soft_beam"], some)
    rows = {row[1]: row[2] for row in report.rows}
    assert rows["twin"] == "2 (1 of 3 seeds)" and rows["rigid follow"] == "20 (1 of 3 seeds)"
    assert rows["world model, fine-tuned"] == "not run"
    assert report.figures["relations"]["network_alone_against_twin"]["by_scene"]["soft_beam"]["by_seed"] == {
        "1": pytest.approx(10.0)
    }


def test_a_scene_whose_twin_is_fitted_in_another_way_has_cells_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Cells, "case", lambda self, name: name)
    scene = next(iter(paper_tables.FITS))
    Cells(tmp_path, None).fill(f"{scene}/full/0", lambda case: {})
    monkeypatch.delitem(paper_tables.FITS, scene)
    assert Cells(tmp_path, None).get(f"{scene}/full/0") is None


def test_a_small_ratio_is_not_printed_as_nothing() -> None:
    some = held(["soft_beam"]) | {"soft_beam/no_prior/0": cell(2.0, 2.0)}
    text = summarise(["soft_beam"], some).markdown()
    assert "no prior (400 steps): track error ratio 0.002 (soft_beam 0.002); below 1 in 1 of 1 pairs" in text


def test_hidden_points_of_training_frames_are_filled_from_training_frames_alone() -> None:
    scene = made_scene(np.zeros((2, 3)), "rope", frames=10)
    scene.points[:, :, 0] = np.arange(10)[:, None]
    scene.visible[5:7, 0] = scene.visible[8, 0] = False
    scene.points[~scene.visible] = 99.0
    filled = filled_in(replace(scene, train=(0, 7), test=(7, 10)))
    assert filled[:, 0, 0].tolist() == [0, 1, 2, 3, 4, 4, 4, 7, 8, 9]
    assert filled[:, 1, 0].tolist() == list(range(10))
