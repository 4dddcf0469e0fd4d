"""Recordings with a secret: what counts as a right answer, beside effects that the library has."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.trace.hidden_cases import cases
from benchmarks.trace.hidden_effects import page, scored

CASES = {case.name: case for case in cases()}


def report(verdict: str, *names: str) -> dict[str, Any]:
    """A trace's answer with these effects, the first one named and the others as good."""
    effects = [{"name": name, "parameters": {"offset_s": {"value": 0.03}}} for name in names]
    out = {"before": 5e-3, "after": 1e-3, "noise_floor": 1e-3, "explained_fraction": 1.0}
    return {
        "scene": "e", "verdict": verdict, "effects": effects[:1], "equivalent": effects[1:], "calibrated": {},
        "held_out": out, "training": {"misfit_before": 5.0, "misfit_after": 1.0}, "simulations": 9, "seconds": 1.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("case", "answer", "right", "wrong_name"),
    [
        ("e01", ("nothing_to_explain",), True, False),
        ("e01", ("named", "wind"), False, True),
        ("e06", ("unexplained",), True, False),  # a gust: outside the library
        ("e06", ("named", "wind"), False, True),
        ("e07", ("data_issue", "measurement_clock"), True, False),
        ("e07", ("equivalent_set", "actuation_lag", "measurement_clock"), True, False),
        ("e07", ("named", "actuation_lag"), False, True),
        ("e07", ("nothing_to_explain",), False, False),
        ("e02", ("named", "air_drag_linear"), False, True),
    ],
)
def test_an_answer_is_right_if_it_says_what_acts_and_no_more(
    case: str, answer: tuple[str, ...], right: bool, wrong_name: bool, tmp_path: Path
) -> None:
    known = CASES[case]
    strength = "clear" if known.acts else "none"
    truth = {"parameters": known.acts, "strength": strength, "signature_sigmas_test": 5.0}
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    row = scored(known, tmp_path, report(*answer)) | {"scene": case}
    assert (row["right"], row["wrong_name"]) == (right, wrong_name)
    text = page([row]).markdown()
    assert f"| {case} | beam |" in text and "e12" in text.split("Not traced:")[1]
