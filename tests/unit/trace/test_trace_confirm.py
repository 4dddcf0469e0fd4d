"""Refits: a rival is searched where the best model fits; a tether also from where it does the same to first order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from modelled_bar import Bar
from sagging_bar import BUDGET, TRUE_PA, sagging

from physworld.effects.places import middle_of_free_end
from physworld.effects.registry import effect
from physworld.trace.candidates import candidates
from physworld.trace.compound import in_parts
from physworld.trace.config import TraceConfig
from physworld.trace.confirm import Confirmation, Model
from physworld.trace.selection import Selection
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

VISCOSITY_PA_S, FAR_PA, STIFF_N_M = 120.0, 1.2e5, 3.0


@pytest.fixture(scope="module")
def bar() -> Bar:
    return Bar(effect("viscosity_kelvin_voigt", viscosity_pa_s=VISCOSITY_PA_S))


def test_a_rival_is_searched_where_the_best_model_fits(bar: Bar) -> None:
    best = bar.model("viscosity_kelvin_voigt", TRUE_PA, viscosity_pa_s=VISCOSITY_PA_S)
    lost = bar.model("air_drag_linear", FAR_PA, rate_per_s=8.0)
    assert best.fitted.misfit < 1.1 and lost.fitted.misfit > 5.0
    found = bar.confirmation.beside(lost, best)
    assert found.names == ("air_drag_linear",)
    assert found.fitted.misfit < 0.4 * lost.fitted.misfit
    assert found.fitted.value("youngs_modulus_pa") == pytest.approx(TRUE_PA, rel=0.1)
    assert 1.0 < found.fitted.value("air_drag_linear.rate_per_s") < 3.0


def test_a_rival_that_fits_nowhere_near_the_best_model_is_left_as_it_is(bar: Bar) -> None:
    good = bar.model("air_drag_linear", 0.97 * TRUE_PA, rate_per_s=8.0)
    elsewhere = bar.model("viscosity_kelvin_voigt", 4 * TRUE_PA, viscosity_pa_s=VISCOSITY_PA_S)
    runs = bar.simulations.count
    assert bar.confirmation.beside(good, elsewhere) is good
    assert bar.simulations.count == runs + 8  # a look at eight strengths, and no search


def test_a_rival_is_searched_in_every_basin_where_a_model_is_complete(
    bar: Bar, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best may be what is not believed in the end, at a stiffness where no other effect fits."""
    right = bar.model("viscosity_kelvin_voigt", TRUE_PA, viscosity_pa_s=VISCOSITY_PA_S)
    near = bar.model("viscosity_kelvin_voigt", 1.01 * TRUE_PA, viscosity_pa_s=VISCOSITY_PA_S)
    away = bar.model("gravity_tilt", 20 * TRUE_PA, tilt_x_rad=0.0, tilt_y_rad=0.0)
    best = replace(away, fitted=replace(away.fitted, residual=0.95 * right.fitted.residual))
    lost = bar.model("air_drag_linear", FAR_PA, rate_per_s=8.0)
    selection = Selection(bar.simulations, bar.white, bar.blocks, bar.frames, TraceConfig())
    assert right.fitted.misfit < near.fitted.misfit <= TraceConfig().near_floor < lost.fitted.misfit
    asked: list[Model] = []

    def watched(confirmation: Confirmation, model: Model, place: Model) -> Model:
        asked.extend([place] if model is lost else [])
        return model

    monkeypatch.setattr(Confirmation, "beside", watched)
    assert selection._from_better_basins(bar.confirmation, [best, right, near, lost])[-1] is lost
    assert [id(place) for place in asked] == [id(best), id(right)]


def test_the_first_of_two_effects_is_exchanged_for_its_like(
    bar: Bar, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A linear drag may be nearer alone where a quadratic one and something else act."""
    declared = bar.declared(TRUE_PA)
    linear = bar.model("air_drag_linear", TRUE_PA, rate_per_s=2.0)
    viscous = bar.model("viscosity_kelvin_voigt", TRUE_PA, viscosity_pa_s=VISCOSITY_PA_S)
    tilt = bar.model("gravity_tilt", TRUE_PA, tilt_x_rad=0.0, tilt_y_rad=0.05)
    lag = bar.model("actuation_lag", TRUE_PA, lag_s=0.02)
    gate = lag.fitted.unknowns[-1]
    both = replace(linear.fitted, unknowns=[*linear.fitted.unknowns, gate])
    both = replace(both, theta=np.append(linear.fitted.theta, gate.start))
    pair = replace(linear, members=(*linear.members, *lag.members), fitted=both)
    selection = Selection(bar.simulations, bar.white, bar.blocks, bar.frames, TraceConfig())
    asked: list[tuple[tuple[str, ...], list[float]]] = []

    def together(self: Confirmation, base: Model, members: tuple, strengths: list, other: Model) -> Model:
        assert base is declared and other is pair
        asked.append((tuple(member.effect for member in members), strengths))
        return replace(pair, members=members)

    monkeypatch.setattr(Confirmation, "together", together)
    singles, given = [linear, viscous, tilt, lag], (bar.confirmation, declared, linear)
    assert pair.fitted.misfit > TraceConfig().near_floor
    found = selection._exchanged(*given, singles, [pair])
    assert [model.names for model in found] == [
        ("air_drag_linear", "actuation_lag"), ("viscosity_kelvin_voigt", "actuation_lag")
    ]  # fmt: skip
    assert asked == [(found[1].names, pytest.approx([VISCOSITY_PA_S, 0.02]))]
    complete = replace(pair, fitted=replace(both, residual=np.ones_like(both.residual)))
    assert selection._exchanged(*given, singles, [complete]) == [complete]
    assert selection._exchanged(*given, singles, []) == []


def test_plates_are_asked_of_all_that_explain_nearly_everything(
    bar: Bar, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A drag at 1.41 of the noise lost to a Maxwell branch at 1.13 that was a plate; as one it reaches 1.13 too."""
    known = bar.declared(TRUE_PA)

    def leaving(misfit: float) -> Model:
        same = np.full_like(known.fitted.residual, misfit)
        return replace(known, fitted=replace(known.fitted, residual=same))

    base, best, near, far = leaving(6.4), leaving(1.13), leaving(1.41), leaving(2.7)
    asked: list[float] = []
    monkeypatch.setattr(
        "physworld.trace.selection.as_a_plate", lambda fitted, *rest: asked.append(fitted.misfit)
    )
    selection = Selection(bar.simulations, bar.white, bar.blocks, bar.frames, TraceConfig())
    assert selection._as_plates(base, [best, near, far]) == [best, near, far]
    assert asked == pytest.approx([1.13, 1.41])


def test_a_tether_is_also_searched_on_the_other_side() -> None:
    rest, pulled = 0.1, 0.02
    attach = middle_of_free_end(build_twin(sagging(), BUDGET))

    def shape(gap: float) -> dict[str, float]:
        """An anchor this far along y."""
        anchor = dict(
            zip(("anchor_x_m", "anchor_y_m", "anchor_z_m"), attach + np.array([0.0, gap, 0.0]), strict=True)
        )
        return {"rest_length_m": rest} | anchor

    tied = Bar(effect("tether", stiffness_n_m=STIFF_N_M, **shape(-rest - pulled)))
    lost = tied.model("tether", TRUE_PA, shape(rest - pulled), stiffness_n_m=STIFF_N_M)
    assert lost.members[0].mirror(shape(rest - pulled)) == pytest.approx(shape(-rest - pulled))
    found = tied.confirmation.mirrored(lost)
    assert lost.fitted.misfit > 2.0 and found.fitted.misfit < 1.2
    way = [found.fitted.value(f"tether.anchor_{a}_m") for a in "xyz"] - attach
    tension = found.fitted.value("tether.stiffness_n_m") * (np.linalg.norm(way) - rest)
    assert way[1] < -0.8 * np.linalg.norm(way)
    assert tension == pytest.approx(STIFF_N_M * pulled, rel=0.1)


def test_an_effect_without_a_mirror_image_is_left_as_it_is(bar: Bar) -> None:
    drag = bar.model("air_drag_linear", FAR_PA, rate_per_s=8.0)
    runs = bar.simulations.count
    assert bar.confirmation.mirrored(drag) is drag and bar.simulations.count == runs


def test_a_wind_is_taken_apart_into_a_drag_and_a_tilt_of_gravity() -> None:
    wind = {"push_x_m_s2": 0.0, "push_y_m_s2": 0.6, "push_z_m_s2": 0.0, "rate_per_s": 3.0}
    blown = Bar(effect("wind", **wind))
    whole, base = blown.model("wind", TRUE_PA, **wind), blown.declared(TRUE_PA)
    parts = in_parts(blown.confirmation, base, whole, candidates(blown.plain)[0])
    assert parts is not None and parts.names == ("air_drag_linear", "gravity_tilt")
    assert parts.fitted.misfit == pytest.approx(whole.fitted.misfit, rel=0.03) and base.fitted.misfit > 3.0
    assert parts.fitted.value("air_drag_linear.rate_per_s") == pytest.approx(3.0, rel=0.1)
    tilt = parts.fitted.value("gravity_tilt.tilt_x_rad")
    assert np.cross([np.sin(tilt), 0.0, 0.0], blown.plain.gravity_m_s2)[1] == pytest.approx(0.6, rel=0.1)
    assert in_parts(blown.confirmation, base, whole, candidates(blown.plain, ("air_drag_linear",))[0]) is None


def test_a_tilt_is_known_to_be_small_and_a_strong_recording_overrules_that() -> None:
    bar = Bar(effect("gravity_tilt", tilt_x_rad=0.05, tilt_y_rad=0.3))
    found = bar.confirmation.further(bar.model("gravity_tilt", TRUE_PA, tilt_x_rad=0.01, tilt_y_rad=0.01))
    tilts = {u.name: u for u in found.fitted.unknowns if u.prior is not None}
    assert set(tilts) == {"gravity_tilt.tilt_x_rad", "gravity_tilt.tilt_y_rad"}
    for unknown in tilts.values():
        assert unknown.prior is not None and unknown.value(unknown.prior[1]) == pytest.approx(0.1)
    assert found.fitted.value("gravity_tilt.tilt_y_rad") == pytest.approx(0.3, rel=0.06)
    assert found.fitted.misfit < 1.05
