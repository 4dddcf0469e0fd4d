"""Tethers between the directions that are tried: their sensitivities, their places, and when none is looked for."""

from __future__ import annotations

import numpy as np
import pytest
from modelled_bar import Bar
from sagging_bar import TRUE_PA

from physworld.effects.places import body_size, middle_of_free_end
from physworld.effects.registry import effect
from physworld.trace.candidates import candidates
from physworld.trace.confirm import Model
from physworld.trace.score import Scores, orthonormal, project, scores
from physworld.trace.sensitivity import Response, candidate_responses
from physworld.trace.tethers import _any_length, tethers_between, with_tethers

pytestmark = pytest.mark.slow

STIFFNESS_N_M, COMPLETE = 2.0, 1.2
WAY = np.array([0.35, 0.9, -0.25]) / np.linalg.norm([0.35, 0.9, -0.25])


@pytest.fixture(scope="module")
def tied() -> Bar:
    """A bar whose free end a tether pulls askew: longer than its rest length, which is half the bar's."""
    plain = Bar(effect("air_drag_linear")).plain
    rest = 0.5 * body_size(plain)
    anchor = middle_of_free_end(plain) + 1.2 * rest * WAY
    place = {f"anchor_{a}_m": float(c) for a, c in zip("xyz", anchor, strict=True)}
    return Bar(effect("tether", stiffness_n_m=STIFFNESS_N_M, rest_length_m=rest, **place))


def _responses(bar: Bar, base: Model, *names: str) -> list[Response]:
    chosen, _ = candidates(bar.plain, names)
    fitted = base.fitted
    return candidate_responses(bar.simulations, bar.white, fitted.twin, fitted.tracks, chosen, bar.frames)


def _ranked(bar: Bar, base: Model, usable: list[Response]) -> Scores:
    fitted = base.fitted
    return scores(fitted.residual, fitted.free_jacobian, usable, [], bar.blocks, 0.05, 20, 0)


def test_a_tether_s_sensitivity_is_a_combination_of_those_along_axes_and_diagonals(tied: Bar) -> None:
    base = tied.declared(TRUE_PA)
    starts = tethers_between(base.fitted, _responses(tied, base, "tether", "region_force"))
    assert len({start.score.candidate.label for start in starts}) > 5
    best = starts[0]
    run = candidate_responses(
        tied.simulations,
        tied.white,
        base.fitted.twin,
        base.fitted.tracks,
        [best.score.candidate],
        tied.frames,
    )[0].columns
    assert np.linalg.norm(best.columns - run) < 0.15 * np.linalg.norm(run)  # the bar moves by a part of l
    left = project(orthonormal(base.fitted.free_jacobian), base.fitted.residual)
    for start in starts:
        rest = left - start.score.direction
        assert start.score.share == pytest.approx(1.0 - float(rest @ rest) / float(left @ left), abs=1e-9)


def test_a_tether_between_the_directions_is_found(tied: Bar) -> None:
    base = tied.declared(TRUE_PA)
    usable = _responses(tied, base, "tether", "region_force")
    ranked = _ranked(tied, base, usable)
    found = with_tethers(tied.confirmation, base, ranked, {}, usable, [], COMPLETE)
    assert [model.names for model in found] == [("tether",)]
    fitted = found[0].fitted
    assert base.fitted.misfit > 3.0 and fitted.misfit < COMPLETE
    way = [fitted.value(f"tether.anchor_{a}_m") for a in "xyz"] - middle_of_free_end(tied.plain)
    assert float(way @ WAY) > 0.95 * np.linalg.norm(way)
    rest = next(known.values for known in fitted.twin.effects if known.name == "tether")["rest_length_m"]
    tension = fitted.value("tether.stiffness_n_m") * (np.linalg.norm(way) - rest)
    assert tension == pytest.approx(STIFFNESS_N_M * 0.2 * 0.5 * body_size(tied.plain), rel=0.25)


def test_the_rest_length_is_freed_where_that_predicts_better(tied: Bar) -> None:
    end, rest = middle_of_free_end(tied.plain), 0.5 * body_size(tied.plain)

    def shape(length: float) -> dict[str, float]:
        anchor = zip("xyz", end + 1.2 * rest * WAY, strict=True)
        return {f"anchor_{a}_m": float(c) for a, c in anchor} | {"rest_length_m": length}

    lost = tied.model("tether", TRUE_PA, shape(0.3 * rest), stiffness_n_m=STIFFNESS_N_M)
    freed = _any_length(tied.confirmation, lost)
    assert lost.fitted.misfit > 2.0 and freed.fitted.misfit < COMPLETE
    assert "tether.rest_length_m" in [unknown.name for unknown in freed.fitted.unknowns]
    right = tied.model("tether", TRUE_PA, shape(rest), stiffness_n_m=STIFFNESS_N_M)
    assert _any_length(tied.confirmation, right) is right


def test_none_is_looked_for_where_a_model_is_complete_or_a_tether_is_in_it(tied: Bar) -> None:
    base = tied.declared(TRUE_PA)
    usable = _responses(tied, base, "tether", "region_force")
    ranked, runs = _ranked(tied, base, usable), tied.simulations.count
    tried = [base]
    assert with_tethers(tied.confirmation, base, ranked, {}, usable, tried, 1e9) is tried
    nothing: list[Model] = []
    assert with_tethers(tied.confirmation, base, ranked, {}, usable, nothing, 1e9) is nothing
    other = tied.model("tether", TRUE_PA, stiffness_n_m=STIFFNESS_N_M)
    assert with_tethers(tied.confirmation, other, ranked, {}, usable, tried, COMPLETE) is tried
    assert tied.simulations.count <= runs + 3  # of the model made here


def test_without_springs_in_all_directions_there_is_none(tied: Bar) -> None:
    base = tied.declared(TRUE_PA)
    usable = _responses(tied, base, "tether")
    assert tethers_between(base.fitted, []) == []
    assert tethers_between(base.fitted, usable[:5]) == []
    relaxed = tethers_between(base.fitted, usable)  # no force known: only such as are relaxed at the start
    assert len(relaxed) == 1
