"""Second resolution: an effect does the same there if what the calibrated numbers do not absorb of it is the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from modelled_bar import Bar
from sagging_bar import TRUE_PA

from physworld.effects.registry import effect
from physworld.trace.config import TraceConfig
from physworld.trace.confirm import Model
from physworld.trace.second_resolution import SecondResolution

DRAG_PER_S = 3.0


@pytest.fixture(scope="module")
def bar() -> Bar:
    return Bar(effect("air_drag_linear", rate_per_s=DRAG_PER_S))


def drag(bar: Bar, rate_per_s: float) -> Model:
    return bar.model("air_drag_linear", TRUE_PA, rate_per_s=rate_per_s)


def second(bar: Bar) -> SecondResolution:
    return SecondResolution(bar.simulations, bar.white, bar.blocks, bar.frames, TraceConfig(), bar.plain)


@pytest.mark.parametrize(("there", "same"), [(DRAG_PER_S, True), (0.9 * DRAG_PER_S, True), (2.0, False)])
def test_an_effect_does_the_same_if_it_moves_the_body_as_much(bar: Bar, there: float, same: bool) -> None:
    coarse, fine = drag(bar, DRAG_PER_S), drag(bar, there)
    assert second(bar).does_the_same(coarse.fitted, fine.fitted, coarse.members[0]) == same


@pytest.mark.parametrize(("way", "same"), [("absorbed", True), ("its own", False)])
def test_what_the_calibrated_numbers_absorb_of_it_may_differ(bar: Bar, way: str, same: bool) -> None:
    coarse = drag(bar, DRAG_PER_S)
    stiffer = bar.model("air_drag_linear", 1.002 * TRUE_PA, rate_per_s=DRAG_PER_S).fitted.tracks
    freer = drag(bar, 0.98 * DRAG_PER_S).fitted.tracks
    change = (stiffer if way == "absorbed" else freer) - coarse.fitted.tracks
    effect_size = np.linalg.norm(bar.white.change(drag(bar, 0.01).fitted.tracks - coarse.fitted.tracks))
    change *= 0.5 * effect_size / np.linalg.norm(bar.white.change(change))
    fine = replace(coarse.fitted, tracks=coarse.fitted.tracks + change)
    assert second(bar).does_the_same(coarse.fitted, fine, coarse.members[0]) == same


def test_an_effect_without_a_run_to_compare_with_does_not(bar: Bar) -> None:
    coarse = drag(bar, DRAG_PER_S)
    broken = coarse.fitted.twin.with_parameters(youngs_modulus_pa=1e16)
    known = second(bar)
    known.simulations.least_step_s = 1e-6
    try:
        fine = replace(coarse.fitted, twin=broken)
        assert not known.does_the_same(coarse.fitted, fine, coarse.members[0])
    finally:
        known.simulations.least_step_s = 0.0


@pytest.mark.parametrize(("cells", "agrees"), [(0.0, True), (100.0, False)])
def test_where_cells_change_more_than_an_effect_explains_its_rivals_are_asked_too(
    bar: Bar, cells: float, agrees: bool
) -> None:
    """Coarse cells say viscosity, finer ones drag, and drag it is."""
    right = drag(bar, DRAG_PER_S)
    there = bar.confirmation.further(bar.model("viscosity_kelvin_voigt", TRUE_PA, viscosity_pa_s=20.0))
    assert there.validated.mean > 1.2 * right.validated.mean
    wrong = replace(
        there,
        fitted=replace(there.fitted, residual=0.99 * right.fitted.residual),
        validated=replace(right.validated, errors=0.99 * right.validated.errors),
    )
    asked = replace(second(bar), cells=cells)
    _, agreement = asked.check(bar.declared(TRUE_PA), [wrong, right])
    assert agreement[wrong.names] == agrees
    if not agrees:  # and the next best one is asked
        assert agreement[right.names]
