"""The posterior of effects, and the answer that it gives."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from physworld.effects.registry import effect
from physworld.estimation.left_out import LeftOut
from physworld.trace.answer import decided
from physworld.trace.candidates import Candidate
from physworld.trace.posterior import posterior, removes
from physworld.trace.screening import Screened
from physworld.trace.search import Search
from physworld.trace.starts import Begun

BLOCKS, ROWS = 5, 12


def unseen(*errors: float, rows: int = 100) -> LeftOut:
    return LeftOut(np.array(errors), np.full(len(errors), rows))


def test_a_posterior_prefers_what_predicts_and_what_is_simple() -> None:
    plain = unseen(*[6.0] * 12)
    better = unseen(*[1.0] * 12)
    price = -np.log(40.0)
    weights = posterior([plain, better, better], [0.0, price, price])
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(weights, [0.0, 0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(posterior([plain, plain], [0.0, price]), [40.0 / 41.0, 1.0 / 41.0])


def test_where_the_twin_is_right_a_little_is_decisive_and_where_it_is_not_it_is_nothing() -> None:
    """The same tenth of the error: beside noise alone, and beside a discrepancy of thirty times the noise."""
    assert posterior([unseen(*[1.1] * 12, rows=1000), unseen(*[1.0] * 12, rows=1000)], [0.0, 0.0])[1] > 0.999
    far = posterior([unseen(*[990.0] * 12, rows=1000), unseen(*[900.0] * 12, rows=1000)], [0.0, 0.0])
    assert 0.5 < far[1] < 0.8


def test_what_wins_in_one_block_only_does_not_win_for_sure() -> None:
    even, once = [4.0] * 12, [4.4] * 11 + [0.1]
    found = posterior([unseen(*even, rows=30), unseen(*once, rows=30)], [0.0, 0.0])
    assert 0.2 < found[1] < 0.8


def test_an_effect_removes_a_share_of_what_is_above_the_noise() -> None:
    assert removes(3.0, 1.5) == 0.5, "of the root mean square"
    assert removes(3.0, 0.9) == 1.0
    assert removes(1.04, 1.0) == 0.0, "that much is not known of the noise"


@pytest.mark.parametrize(
    ("wind", "drag", "admitted"), [(1.2, 5.0, True), (1.2, 1.5, False), (4.0, 9.0, False)]
)
def test_a_wind_has_to_earn_its_push_beside_the_drag_that_it_contains(
    wind: float, drag: float, admitted: bool
) -> None:
    search = Search(None, [], None, 1, 1, 1)  # type: ignore[arg-type]
    for name, left in ((None, 10.0), ("air_drag_linear", drag), ("wind", wind)):
        members = () if name is None else (Candidate(name, "", ()),)
        names = () if name is None else (name,)
        search.hypotheses[names] = SimpleNamespace(members=members, left=left)  # type: ignore[assignment]
    assert any(h.members and h.members[0].effect == "wind" for h in search.admitted()) == admitted


def test_without_a_candidate_that_makes_sense_the_declared_physics_has_everything() -> None:
    """A tilt of a gravity that is zero, say, is no candidate."""
    search = Search(None, [], None, 1, 1, 1)  # type: ignore[arg-type]
    unseen = LeftOut(np.full(BLOCKS, 10.0), np.full(BLOCKS, ROWS))
    declared: Any = SimpleNamespace(members=(), left=10.0, log_prior=-1.0, unseen=unseen)
    search.hypotheses[()] = declared
    assert search.library == 0
    np.testing.assert_array_equal(search.weights(), [1.0])


@pytest.mark.parametrize(
    ("declared", "fitted"), [(5.0, [("air_drag_quadratic", "along"), ("tether", "z")]), (1.1, [])]
)
def test_what_promises_little_at_first_is_tried_beside_the_material_of_the_best(
    declared: float, fitted: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Strong effects promise little to first order. Where the declared physics comes near the noise they do not lie."""
    promises = {"along": 0.6, "x": 0.1, "z": 0.5, "": 0.2}
    scores: list[Any] = [
        Screened(Candidate(name, label, ()), {}, 0.05, 1.0)
        for name, label in (("air_drag_quadratic", "along"), ("tether", "x"), ("tether", "z"), ("swirl", ""))
    ]
    best: Any = SimpleNamespace(members=(Candidate("air_drag_linear", "", ()),), left=1.3)
    beside: list[Any] = []

    def scanned(base: Any, one: Screened, known: Any) -> Begun:
        beside.append(known)
        return Begun(one, [{}], promises[one.candidate.variant])

    starts: Any = SimpleNamespace(promised=lambda base, known: 0.9, scanned=scanned)
    setting: Any = SimpleNamespace(simulations=SimpleNamespace(stage=""))
    search = Search(setting, [], starts, 1, 1, 1)
    base: Any = SimpleNamespace(members=(), left=declared, fitted=SimpleNamespace(misfit=declared**0.5))
    search.hypotheses |= {(): base, ("air_drag_linear",): best}
    begun: list[tuple[str, str]] = []
    monkeypatch.setattr(
        search,
        "_fit",
        lambda base, one: begun.append((one.screened.candidate.effect, one.screened.candidate.variant)),
    )
    assert search._scan(base, scores) == bool(fitted)
    assert begun == fitted and all(known is best for known in beside)


def test_what_hardly_any_body_has_needs_more_support() -> None:
    """Dry friction and linear drag that predict alike: the odds in the effect's file decide."""
    search = Search(None, [Candidate("dry_friction", "", ())], None, 1, 1, 1)  # type: ignore[arg-type]
    unseen = LeftOut(np.full(BLOCKS, 1.1), np.full(BLOCKS, ROWS))
    for name in ("dry_friction", "air_drag_linear"):
        alike: Any = SimpleNamespace(
            members=(Candidate(name, "", ()),), left=1.1, log_prior=0.0, unseen=unseen
        )
        search.hypotheses[(name,)] = alike
    search.hypotheses[()] = SimpleNamespace(  # type: ignore[assignment]
        members=(), left=50.0, log_prior=0.0, unseen=LeftOut(np.full(BLOCKS, 50.0), np.full(BLOCKS, ROWS))
    )
    rubs, drags, _ = search.weights()
    assert rubs / drags == pytest.approx(effect("dry_friction").odds)


@pytest.mark.parametrize(
    ("weights", "name"),
    [([0.0, 0.01, 0.99], "unexplained"), ([0.0, 0.94, 0.06], "named"), ([0.06, 0.94, 0.0], "unexplained")],
)
def test_no_other_name_is_given_where_something_unbelievable_predicts_best(
    weights: list[float], name: str
) -> None:
    def known(effect: str | None, misfit: float, doubt: str | None = None) -> Any:
        members = () if effect is None else (SimpleNamespace(effect=effect, kind="force"),)
        names = tuple(member.effect for member in members)
        fitted = SimpleNamespace(misfit=misfit)
        return SimpleNamespace(members=members, names=names, fitted=fitted, doubt=doubt)

    gale = known("wind", 1.0, "a wind of 60 m/s is not believed")
    hypotheses = [known(None, 4.0), known("air_drag_linear", 1.1), gale]
    found = decided(hypotheses, np.array(weights), 1e-3, 0.5, 20)
    assert found.name == name and not found.equivalent
    assert ("not believed" in found.reason) == (weights[2] > 0.9)
