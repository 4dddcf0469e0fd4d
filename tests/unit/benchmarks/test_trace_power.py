"""The power suite's bookkeeping, and that an injection moves the points as far as its level says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.trace.power import tasks
from benchmarks.trace.power_effects import inject, refusal
from benchmarks.trace.power_objects import OBJECTS, observed
from benchmarks.trace.power_picture import draw, draw_calibration
from benchmarks.trace.power_report import (
    RIGHT,
    SET,
    WRONG,
    calibration,
    interval,
    limit,
    outcome,
    page,
    summary,
)
from physworld.effects.registry import EFFECTS, effect

DRAG = "air_drag_linear"


def answer(level: float, verdict: str, *names: str, effect: str | None = DRAG, body: str = "beam", others=()):
    return {
        "object": body, "effect": effect, "level": level, "seed": 0, "outcome": verdict, "names": list(names),
        "equivalent": list(others), "size": level, "unit": "1/s", "commit": "abc", "changed": False,
    }  # fmt: skip


def test_every_effect_comes_at_three_levels_and_partial_runs_have_nulls_and_middle_levels() -> None:
    every = tasks(36)
    assert len({task.key for task in every}) == len(every)
    assert {task.effect for task in every} == {None, *EFFECTS}
    assert sum(task.effect is None for task in every) == 36
    assert all(task.effect is None for task in every[:36])
    assert {task.level for task in every[36 : len(every) // 3]} == {3.0}


def test_answers_are_told_apart() -> None:
    assert outcome(answer(1.0, "named", DRAG)) == RIGHT
    assert outcome(answer(1.0, "equivalent_set", "viscosity_kelvin_voigt", others=[DRAG])) == SET
    assert outcome(answer(1.0, "named", "tether")) == WRONG
    assert outcome(answer(1.0, "unexplained")) == "unexplained"


def test_the_limit_is_the_smallest_level_found_on_half_of_the_objects() -> None:
    rows = [answer(1.0, "nothing_to_explain"), answer(3.0, "named", DRAG), answer(3.0, "unexplained", body="rope"),
            answer(10.0, "named", DRAG), answer(10.0, "named", DRAG, body="rope")]  # fmt: skip
    found = limit(rows, DRAG)
    assert found.half == 3.0 and found.every == 10.0 and found.sizes == {"beam": (3.0, "1/s")}
    assert limit(rows, "tether").half is None


def test_a_claim_is_right_where_it_is_the_one_effect_that_acts() -> None:
    rows = [
        {**answer(3.0, "named", DRAG), "posterior": [[[DRAG], 0.97], [["tether"], 0.03]]},
        {**answer(3.0, "named", "tether"), "posterior": [[["tether"], 0.96], [[DRAG, "tether"], 0.04]]},
        {**answer(0.0, "nothing_to_explain", effect=None), "posterior": [[[], 1.0]]},
        {**answer(0.0, "named", DRAG, effect=None, body="damped"), "posterior": [[[DRAG], 1.0]]},
    ]
    found = {bin["to"]: (bin["right"], bin["claims"]) for bin in calibration(rows)}
    assert found[1.0] == (1, 2) and found[0.1] == (0, 2) and sum(many for _, many in found.values()) == 4


def test_the_interval_is_that_of_clopper_and_pearson() -> None:
    assert interval(0, 30) == pytest.approx((0.0, 1 - 0.025 ** (1 / 30)))
    low, high = interval(3, 30)
    assert low == pytest.approx(0.0211, abs=1e-4) and high == pytest.approx(0.2653, abs=1e-4)


def test_a_partial_run_makes_a_page_with_its_counts_and_a_picture(tmp_path: Path) -> None:
    rows = [
        answer(3.0, "named", DRAG),
        answer(0.0, "named", "tether", effect=None),
        answer(0.0, "unexplained", effect=None),
    ]
    found = summary(rows, 267)
    assert found["nulls"]["scenes"] == 2 and found["nulls"]["false_names"] == 1
    text = page(rows, found, 267, ("picture.svg", "curve.svg"), 0).markdown()
    assert "3 of 267" in text and "| `air_drag_linear` | ? ? ? | + ? ? | ? ? ? | 3 | 3 | beam 3 1/s |" in text
    draw(rows, tmp_path / "picture.svg")
    draw_calibration(found["calibration"], tmp_path / "curve.svg")
    for name in ("picture.svg", "curve.svg"):
        assert (tmp_path / name).read_text().startswith("<?xml")


def test_an_injection_displaces_by_its_level_and_a_rope_refuses_fibres() -> None:
    rope = OBJECTS["rope"](0)
    without = observed(rope.truth, rope.scene)
    made = inject("gravity_tilt", rope, without, 3.0)
    assert made is not None and made.displacement == pytest.approx(3.0, rel=0.15) and not made.clipped
    assert made.size == pytest.approx(np.hypot(*made.strengths.values())) and made.unit == "rad"
    assert refusal("anisotropy", rope) is not None and refusal("anisotropy", OBJECTS["sheet"](0)) is None


def test_no_stronger_effect_is_injected_than_anybody_believes() -> None:
    beam = OBJECTS["beam"](0)
    made = inject("gravity_tilt", beam, observed(beam.truth, beam.scene), 30.0)
    assert made is not None and made.clipped and made.size == pytest.approx(0.2, rel=0.02)
    assert effect("gravity_tilt", **made.strengths).implausible() is None
    assert effect("gravity_tilt", **{n: 1.1 * s for n, s in made.strengths.items()}).implausible() is not None
