"""The benchmarks' harness: interleaving, medians, JSON and the docs' sections."""

from __future__ import annotations

import json
from pathlib import Path

import pytest


@pytest.fixture
def harness(repository: Path, monkeypatch: pytest.MonkeyPatch):
    """``benchmarks.harness``; the benchmarks are no installed package."""
    monkeypatch.syspath_prepend(str(repository))
    from benchmarks import harness

    return harness


def test_cases_are_run_in_turn_and_summarised_by_their_median(harness):
    order = []

    def case(name, values):
        def run():
            order.append(name)
            return values.pop(0)

        return run

    timings = harness.interleave({"a": case("a", [3.0, 1.0, 2.0]), "b": case("b", [5.0, 5.0, 8.0])}, 3)
    assert order == ["a", "b"] * 3
    assert timings["a"].median == 2.0
    assert timings["a"].spread == 0.5
    assert timings["b"].rounds == (5.0, 5.0, 8.0)
    assert harness.summarise([4.0]).spread == 0.0


def test_a_report_goes_to_json_and_back_and_its_figures_lie_at_the_top(harness, tmp_path):
    report = harness.Report("mpm", "Title", {"ns": {"ours": 1.5}}, ["a", "b"], [["1", "2"]], ["note"], 3)
    harness.write_json(report, tmp_path / "deep" / "report.json")
    written = json.loads((tmp_path / "deep" / "report.json").read_text())
    assert written["ns"] == {"ours": 1.5}
    assert harness.read_json(tmp_path / "deep" / "report.json").markdown() == report.markdown()
    assert {"cpu", "cores", "date", "packages", "python"} <= set(report.machine)


def test_a_section_is_replaced_between_its_markers_and_the_rest_is_left_alone(harness, tmp_path):
    docs = tmp_path / "benchmarks.md"
    docs.write_text("# Head\n\nBy hand.\n")
    first = harness.Report("one", "First", {}, ["a"], [["1"]])
    other = harness.Report("two", "Second", {}, ["a"], [["2"]])
    harness.write_section(first, docs)
    harness.write_section(other, docs)
    again = harness.Report("one", "First again", {}, ["a"], [["3"]])
    harness.write_section(again, docs)
    text = docs.read_text()
    assert text.startswith("# Head\n\nBy hand.\n")
    assert "First again" in text and "## First\n" not in text
    assert text.index("First again") < text.index("## Second")
    assert text.count("<!-- one: begin -->") == 1
    assert "| 3 |" in text


def test_all_but_the_first_notes_and_the_machine_fold_away(harness):
    notes = [f"note {number}" for number in range(4)]
    shown, _, hidden = (
        harness.Report("one", "First", {}, ["a"], [["1"]], notes).markdown().partition("<details")
    )
    assert "- note 1" in shown and "note 2" not in shown and "python -m" not in shown
    assert "- note 2\n- note 3\n\n_`python -m" in hidden and hidden.endswith("_\n\n</details>\n")
