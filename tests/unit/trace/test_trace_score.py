"""Scores on made residuals: what is projected out scores nothing, signs and bounds count, chance has a threshold."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.effects.base import Strength
from physworld.trace.candidates import Candidate
from physworld.trace.confirm import best_variants
from physworld.trace.score import Score, scores
from physworld.trace.sensitivity import Response

BLOCKS, ROWS = 10, 400
BLOCK_OF_ROW = np.repeat(np.arange(BLOCKS), ROWS // BLOCKS)


def response(name: str, column: np.ndarray, low: float = -10.0) -> Response:
    gate = Strength("s", "1", low, 10.0, 1.0)
    return Response(Candidate(name, "", (gate,)), column[:, None])


def test_only_what_calibration_cannot_do_scores() -> None:
    rng = np.random.default_rng(0)
    stiffness, drag, other = rng.normal(size=(3, ROWS))
    residual = 3.0 * stiffness + 2.0 * drag + rng.normal(scale=0.1, size=ROWS)
    candidates = [response("drag", drag), response("stiffness again", stiffness), response("other", other)]
    found = scores(residual, stiffness[:, None], candidates, [other[:, None]], BLOCK_OF_ROW, 0.05, 500, 0)
    first = found.ranked[0]
    assert first.candidate.effect == "drag" and first.share > 0.98 and first.share > found.threshold
    assert first.strengths == pytest.approx([2.0], abs=0.05)
    assert all(score.share < 0.05 for score in found.ranked[1:]) and max(found.decoys) < 0.05


def test_effects_are_refitted_in_turn_by_their_best_variant_and_by_all_together() -> None:
    shape = Strength("shape", "1", -1.0, 1.0, 0.1)

    def score(name: str, share: float, family: float, variant: str = "") -> Score:
        gate = Strength("s", "1", 0.0, 10.0, 1.0)
        shapes = (shape,) if variant else ()
        candidate = Candidate(name, variant, (gate,), {"shape": 0.0} if variant else {}, shapes)
        return Score(candidate, share, np.ones(1), np.ones(1), 0.0, family)

    ranked = [score("drag", 0.5, 0.5), score("lag", 0.3, 0.3), score("field", 0.2, 0.6, "slope"),
              score("field", 0.1, 0.6, "bump"), score("weak", 0.01, 0.01)]  # fmt: skip
    found = best_variants(ranked, 0.03, 8)
    assert [own[0].candidate.effect for own in found] == ["drag", "field", "lag"]
    assert [len(own) for own in found] == [1, 2, 1]
    assert [own[0].candidate.effect for own in best_variants(ranked, 0.03, 2)] == ["drag", "field"]


def test_a_strength_of_one_sign_does_not_explain_the_other() -> None:
    rng = np.random.default_rng(0)
    drag = rng.normal(size=ROWS)
    found = scores(-drag, np.zeros((ROWS, 0)), [response("drag", drag, 0.0)], [], BLOCK_OF_ROW, 0.05, 100, 0)
    assert found.ranked[0].share == pytest.approx(0.0, abs=1e-12)


def test_the_family_is_wrong_as_often_as_it_says() -> None:
    rng = np.random.default_rng(3)
    false = 0
    for _ in range(200):
        noise = np.repeat(rng.normal(size=ROWS // 20), 20) + 0.3 * rng.normal(
            size=ROWS
        )  # neighbours are alike
        slow = [np.repeat(rng.normal(size=ROWS // 20), 20) for _ in range(8)]
        candidates = [response(str(k), column) for k, column in enumerate(slow)]
        found = scores(noise, np.zeros((ROWS, 0)), candidates, [], BLOCK_OF_ROW, 0.05, 200, 0)
        false += found.ranked[0].share > found.threshold
    assert false <= 20  # 5 % of 200 is 10; more than 20 would be beyond chance
