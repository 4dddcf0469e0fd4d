"""Verdicts from made refits: each answer has a case, and the same case without its reason has another."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from physworld.effects.registry import effect
from physworld.estimation.refit import Refit
from physworld.estimation.unknowns import Unknown
from physworld.trace.candidates import Candidate
from physworld.trace.comparison import cross_validated
from physworld.trace.config import TraceConfig
from physworld.trace.confirm import Model
from physworld.trace.score import Score, Scores
from physworld.trace.selection import by_chance
from physworld.trace.verdict import Verdict, decide, implausible

BLOCKS, ROWS = 10, 2000
BLOCK_OF_ROW = np.repeat(np.arange(BLOCKS), ROWS // BLOCKS)
RNG = np.random.default_rng(5)
NOISE, DRAG, OTHER, THIRD = RNG.normal(size=(4, ROWS))
CONFIG = TraceConfig()


def model(residual: np.ndarray, *effects: str, kind: str = "force", unknowns: int = 1) -> Model:
    """A model whose refit left ``residual``."""
    known = [Unknown(str(k), "1", -9.0, 9.0, lambda twin, value: twin) for k in range(unknowns)]
    slope = np.full((ROWS, unknowns), 1e-3)
    twin = SimpleNamespace(effects=())
    fitted = Refit(known, twin, np.zeros(unknowns), np.zeros((1, 1, 3)), residual, slope)
    members = tuple(Candidate(name, "", (), kind=kind) for name in effects)
    return Model(members, fitted, cross_validated(fitted, BLOCK_OF_ROW))


def answer(
    models: list[Model],
    declared: np.ndarray,
    agree: bool = True,
    resolved: float = 9.0,
    solver: np.ndarray | None = None,
    chance: Callable[[Model], bool] = lambda model: False,
) -> tuple[str, tuple[str, ...]]:
    agreement = {m.names: agree for m in models}
    facts = (np.zeros((ROWS, 0)) if solver is None else solver, BLOCK_OF_ROW, chance)
    found = decide(model(declared), models, np.zeros((ROWS, 0)), agreement, resolved, CONFIG, 20, *facts)
    return found.name, found.model.names


def test_noise_is_nothing_and_a_share_that_no_effect_takes_is_unexplained() -> None:
    assert answer([model(NOISE, "drag")], NOISE) == ("nothing_to_explain", ())
    assert answer([model(NOISE + 2 * DRAG, "drag")], NOISE + 2 * DRAG) == ("unexplained", ())


def test_an_effect_is_named_if_it_reaches_the_noise_and_no_other_does() -> None:
    before = NOISE + 2 * DRAG
    assert answer([model(NOISE, "drag"), model(NOISE + 1.5 * DRAG, "wind")], before) == ("named", ("drag",))


def test_what_leaves_too_much_is_not_named() -> None:
    before = NOISE + 4 * DRAG + 3 * OTHER
    assert answer([model(NOISE + 3 * OTHER, "drag")], before) == ("unexplained", ())


@pytest.mark.parametrize(("kinds", "verdict"), [(("force", "force"), "equivalent_set"),
                                                (("boundary", "measurement"), "equivalent_set"),
                                                (("measurement", "measurement"), "data_issue")])  # fmt: skip
def test_effects_that_do_the_same_are_a_set_and_faults_of_the_data_are_called_so(
    kinds: tuple[str, str], verdict: str
) -> None:
    before = NOISE + 2 * DRAG
    rivals = [model(NOISE, "lag", kind=kinds[0]), model(NOISE + 1e-3 * OTHER, "clock", kind=kinds[1])]
    assert answer(rivals, before)[0] == verdict


@pytest.mark.parametrize(("verdict", "kind", "added"), [("named", "force", True), ("equivalent_set", "boundary", True),
                                                        ("equivalent_set", "measurement", False),
                                                        ("data_issue", "measurement", False),
                                                        ("unexplained", "force", False)])  # fmt: skip
def test_a_twin_carries_what_is_named_or_the_best_of_a_set_but_no_fault_of_the_data(
    verdict: str, kind: str, added: bool
) -> None:
    best = model(NOISE, "lag", kind=kind)
    assert Verdict(verdict, best).added is (best if added else None)


@pytest.mark.parametrize(("left", "verdict"), [(0.9, "equivalent_set"), (1.1, "named")])
def test_what_lies_below_a_noise_that_is_declared_too_large_tells_no_models_apart(
    left: float, verdict: str
) -> None:
    rivals = [model(0.5 * NOISE, "viscosity"), model(left * NOISE, "drag")]
    assert answer(rivals, NOISE + 20 * DRAG)[0] == verdict


def test_a_strength_that_moves_with_the_resolution_is_numerical() -> None:
    assert answer([model(NOISE, "drag")], NOISE + 2 * DRAG, agree=False)[0] == "numerical_issue"
    assert answer([model(NOISE, "drag")], NOISE + 0.5 * DRAG, agree=False)[0] == "nothing_to_explain"


def test_an_effect_that_goes_on_finer_cells_gives_way_to_one_that_does_as_well() -> None:
    models = [model(NOISE, "slip"), model(NOISE + 1e-3 * OTHER, "drag")]
    agreement = {("slip",): False, ("drag",): True}
    facts = (np.zeros((ROWS, 0)), BLOCK_OF_ROW, lambda m: False)
    found = decide(model(NOISE + 2 * DRAG), models, np.zeros((ROWS, 0)), agreement, 9.0, CONFIG, 20, *facts)
    assert (found.name, found.model.names) == ("named", ("drag",))


def test_a_misfit_that_other_cells_explain_is_numerical() -> None:
    before = NOISE + 2 * DRAG
    assert answer([], before, resolved=1.1)[0] == "numerical_issue"
    assert answer([], before, resolved=1.9)[0] == "unexplained"


def test_the_simpler_of_two_that_do_as_well_is_named() -> None:
    rich = model(NOISE * 0.999, "wind", unknowns=4)
    assert answer([rich, model(NOISE, "tilt")], NOISE + 2 * DRAG) == ("named", ("tilt",))


@pytest.mark.parametrize(
    ("left", "verdict"),
    [
        (0.45 * OTHER, "equivalent_set"),
        (0.53 * OTHER, "named"),  # hardly better
        (0.45 * THIRD, "named"),  # the same explanation
    ],
)
def test_one_number_less_is_no_reason_to_prefer_another_explanation_that_predicts_worse(
    left: np.ndarray, verdict: str
) -> None:
    rich = model(1.08 * NOISE + left, "tether", unknowns=4)
    plain = model(1.08 * NOISE + 0.54 * THIRD, "fibres")
    assert answer([rich, plain], NOISE + 2 * DRAG) == (verdict, ("fibres",))


def test_two_effects_are_named_only_where_one_leaves_too_much() -> None:
    before = NOISE + 2 * DRAG + 2 * OTHER
    both = model(NOISE, "drag", "viscosity", unknowns=2)
    assert answer([model(NOISE + 2 * OTHER, "drag"), both], before) == ("named", ("drag", "viscosity"))
    assert answer([model(NOISE + 0.1 * OTHER, "drag"), both], before) == ("named", ("drag",))


def test_a_wind_may_as_well_be_a_drag_where_gravity_is_tilted() -> None:
    before = NOISE + 2 * DRAG
    parts = model(NOISE, "air_drag_linear", "gravity_tilt", unknowns=3)
    wind = model(0.9999 * NOISE, "wind", unknowns=4)
    assert answer([wind, parts], before) == ("equivalent_set", ("air_drag_linear", "gravity_tilt"))
    looser = model(1.05 * NOISE, "wind", unknowns=4)  # one number more absorbs some noise, and predicts worse
    assert answer([looser, parts], before)[0] == "equivalent_set"
    upwards = model(1.1 * NOISE + OTHER, "air_drag_linear", "gravity_tilt", unknowns=3)
    assert answer([wind, upwards], before) == ("named", ("wind",))
    steady, uneven = (
        np.full(ROWS, 1.15),
        np.where(BLOCK_OF_ROW % 2, 1.45, 0.85),
    )  # squared errors over the wind's
    for worse, verdict in (
        (steady, "named"),
        (uneven, "equivalent_set"),
    ):  # the same mean, beyond chance or not
        looser = model(np.sqrt(worse) * NOISE, "air_drag_linear", "gravity_tilt", unknowns=3)
        assert answer([wind, looser], before) == (verdict, ("wind",))
    drag = model(NOISE, "air_drag_linear")
    assert answer([wind, parts, drag], before) == ("named", ("air_drag_linear",))


def test_the_parts_of_a_wind_score_as_the_wind_does() -> None:
    def score(name: str, share: float) -> Score:
        return Score(Candidate(name, "", ()), share, np.ones(1), np.ones(1), 0.0, share)

    known = Scores([score("wind", 0.3), score("air_drag_linear", 0.1), score("gravity_tilt", 0.1)], 0.2, [])
    assert not by_chance(model(NOISE, "air_drag_linear", "gravity_tilt"), known)
    assert not by_chance(model(NOISE, "wind"), known)
    assert by_chance(model(NOISE, "air_drag_linear"), known)
    assert by_chance(model(NOISE, "gravity_tilt", "rest_shape"), known)


def test_what_other_cells_would_change_is_no_effect() -> None:
    along = (DRAG / np.linalg.norm(DRAG))[:, None]
    assert answer([model(NOISE, "drag")], NOISE + DRAG, solver=along)[0] == "unexplained"
    across = (OTHER / np.linalg.norm(OTHER))[:, None]
    assert answer([model(NOISE, "drag")], NOISE + DRAG, solver=across)[0] == "named"


def test_near_the_noise_a_score_that_chance_reaches_is_nothing() -> None:
    before = NOISE + 0.5 * DRAG
    assert answer([model(NOISE, "drag")], before) == ("named", ("drag",))
    assert answer([model(NOISE, "drag")], before, chance=lambda m: True) == ("nothing_to_explain", ())
    assert answer([model(NOISE, "drag")], NOISE + 2 * DRAG, chance=lambda m: True) == ("named", ("drag",))


def test_a_little_more_than_the_noise_that_chance_explains_is_unexplained() -> None:
    before = NOISE + 0.85 * DRAG
    assert CONFIG.near_floor < model(before).fitted.misfit < CONFIG.acceptable
    assert answer([model(NOISE, "drag")], before) == ("named", ("drag",))
    assert answer([model(NOISE, "drag")], before, chance=lambda m: True) == ("unexplained", ())


def test_a_nearly_complete_pair_is_no_evidence_where_a_nearly_complete_effect_is() -> None:
    before, left = NOISE + 4 * DRAG, NOISE + 0.85 * OTHER
    single, pair = model(left, "drag"), model(left, "drag", "viscosity", unknowns=2)
    assert CONFIG.near_floor < single.fitted.misfit < CONFIG.acceptable
    assert answer([single], before) == ("named", ("drag",))
    assert answer([pair], before) == ("unexplained", ())


@pytest.mark.parametrize(("share", "believed"), [(-0.005, True), (0.04, False), (-0.12, False)])
def test_a_body_that_weighs_less_is_not_in_other_gravity(share: float, believed: bool) -> None:
    weaker = model(NOISE, "gravity_tilt")
    weaker.fitted.twin.effects = (effect("gravity_tilt", magnitude=share),)
    assert (implausible(weaker) is None) == believed


@pytest.mark.parametrize(("tilt_rad", "left", "name"), [(0.3, 0.0, "unexplained"), (0.1, 0.0, "named"),
                                                        (0.3, 0.6, "named")])  # fmt: skip
def test_no_other_name_is_given_where_something_unbelievable_explains_more(
    tilt_rad: float, left: float, name: str
) -> None:
    tilted = model(NOISE + left * DRAG, "gravity_tilt")
    tilted.fitted.twin.effects = (effect("gravity_tilt", tilt_x_rad=tilt_rad),)
    tether = model(NOISE + 0.4 * OTHER, "tether")
    found = answer([tilted, tether], NOISE + 4 * DRAG)
    assert found == (
        name,
        {"unexplained": ()}.get(name, ("tether",) if tilt_rad > 0.2 else ("gravity_tilt",)),
    )


@pytest.mark.parametrize(("tilt_rad", "believed"), [(0.15, True), (0.3, False)])
def test_gravity_that_a_plumb_line_shows_to_be_off_is_not_believed(tilt_rad: float, believed: bool) -> None:
    tilted = model(NOISE, "gravity_tilt")
    known = effect("gravity_tilt", tilt_x_rad=0.6 * tilt_rad, tilt_y_rad=-0.8 * tilt_rad)
    tilted.fitted.twin.effects = (known,)
    assert (implausible(tilted) is None) == believed
    assert answer([tilted], NOISE + 2 * DRAG)[0] == ("named" if believed else "unexplained")
