"""A check before any fit: its formulas against drawn data, its intervals against refits, its detectable strengths
against screenings, and what it answers about a small recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.trace.check_trials import CONFIG, FINE_M, bar, detection, spread_of
from physworld.check import INVISIBLE, VISIBLE, check, document
from physworld.check.discrepancy import Block, Discrepancy
from physworld.check.information import POSTERIOR, POWER, Information
from physworld.check.run import CheckResult
from physworld.errors import Cancelled

pytestmark = pytest.mark.slow

ROWS, LIBRARY = 400, 20
NONE = Discrepancy((), 1e-3, 0.1)


@pytest.fixture(scope="module")
def told() -> CheckResult:
    return check(bar(), CONFIG)


def posterior(residual: np.ndarray, jacobian: np.ndarray, gates: np.ndarray) -> float:
    """Of the gates against the numbers alone, by dense Gaussians."""

    def log_density(columns: np.ndarray) -> float:
        covariance = np.eye(len(residual)) + columns @ columns.T
        return float(
            -0.5 * residual @ np.linalg.solve(covariance, residual) - 0.5 * np.linalg.slogdet(covariance)[1]
        )

    gain = log_density(np.hstack([jacobian, gates])) - log_density(jacobian)
    return 1.0 / (1.0 + np.exp(np.log(2.0 * LIBRARY) - gain))


@pytest.mark.parametrize("count", [1, 2])
def test_the_detectable_strength_is_found_in_as_many_recordings_as_it_says(count: int) -> None:
    rng = np.random.default_rng(count)
    jacobian, gates = 3.0 * rng.normal(size=(60, 2)), 2.0 * rng.normal(size=(60, count))
    gates += jacobian[:, :1]
    known = Information.of(np.hstack([jacobian, gates]), NONE, 0.0, LIBRARY)
    _, alone = known.detectable(np.arange(2, 2 + count), np.arange(2))
    trials = 400
    found = 0
    for _ in range(trials):
        data = jacobian @ rng.normal(size=2) + alone[0] * gates[:, 0] + rng.normal(size=60)
        found += posterior(data, jacobian, gates) >= POSTERIOR
    deviation = np.sqrt(POWER * (1.0 - POWER) / trials)
    assert found / trials == pytest.approx(POWER, abs=4.0 * deviation)


def test_what_the_numbers_imitate_is_detected_by_nothing() -> None:
    rng = np.random.default_rng(0)
    jacobian = 1e4 * rng.normal(size=(ROWS, 1))
    other = rng.normal(size=(ROWS, 1))
    known = Information.of(np.hstack([jacobian, jacobian, other]), NONE, 0.0, LIBRARY)
    hidden, _ = known.detectable(np.array([1]), np.array([0]))
    free, _ = known.detectable(np.array([1]), np.array([], dtype=int))
    assert free < 0.01 and hidden > 1.0
    assert known.apart(np.array([1]), np.array([0]), np.array([], dtype=int))[0] == pytest.approx(1.0)
    assert known.apart(np.array([2]), np.array([0]), np.array([], dtype=int))[0] < 0.2


def test_under_a_discrepancy_an_effect_has_to_do_as_much_as_that() -> None:
    rng = np.random.default_rng(1)
    column = rng.normal(size=(ROWS, 1))
    basis = np.linalg.qr(rng.normal(size=(ROWS, 5)))[0]
    discrepancy = Discrepancy((Block(np.arange(ROWS), basis, np.full(5, 1e3)),), 1e-3, 0.1)
    none = np.array([], dtype=int)
    (plain, _), (under, _) = (
        Information.of(column, discrepancy, kappa, LIBRARY).detectable(np.array([0]), none)
        for kappa in (0.0, 0.1)
    )
    expected = np.sqrt(5 * (0.1 * 1e3) ** 2 / float(np.sum(column**2)))
    assert plain < 1.0 and under == pytest.approx(expected)


def test_refits_spread_as_the_expected_intervals_say() -> None:
    scene, refits = bar(FINE_M), 8
    errors = spread_of(scene, check(scene, CONFIG), refits)
    low, high = np.sqrt(chi2.ppf([5e-4, 1.0 - 5e-4], refits) / refits)
    assert set(errors) == {"youngs_modulus_pa", "poissons_ratio", "grip_softness"}
    for name, error in errors.items():
        assert low < np.sqrt(np.mean(error**2)) < high, (name, error)


@pytest.mark.parametrize("effect", ["air_drag_linear", "actuation_lag"])
def test_an_effect_is_found_at_twice_its_detectable_strength_and_not_at_a_tenth(
    told: CheckResult, effect: str
) -> None:
    assert detection(bar(), told, effect, (0.1, 2.0), 2) == {0.1: 0.0, 2.0: 1.0}


def test_a_check_tells_numbers_effects_and_what_hides_them(told: CheckResult) -> None:
    modulus = told.perfect.parameter("youngs_modulus_pa")
    assert modulus.given and modulus.ratio < 0.01
    assert modulus.expected95[0] < modulus.value < modulus.expected95[1]
    assert told.usual.parameter("poissons_ratio").ratio > told.perfect.parameter("poissons_ratio").ratio
    assert told.perfect.effect("air_drag_linear").status == VISIBLE
    for right, off in zip(told.perfect.effects, told.usual.effects, strict=True):
        assert off.multiple >= right.multiple * (1.0 - 1e-9), right.label
    assert told.usual.discrepancy_m == pytest.approx(0.03 * told.motion_m)
    assert told.noise == "declared" and told.sigma_m == bar().noise_sigma_m
    assert "adhesion" in told.refused
    text = document(told)
    assert text["views"][1]["discrepancy_share"] == 0.03 and text["proposal"] is None


def test_more_noise_shows_less() -> None:
    few = replace(CONFIG, candidates=("air_drag_linear", "gravity_tilt"))
    quiet, loud = (check(bar(), replace(few, noise_m=sigma)) for sigma in (1e-4, 1e-1))
    assert loud.noise == "given"
    assert quiet.perfect.effect("air_drag_linear").status == VISIBLE
    assert (
        loud.perfect.effect("air_drag_linear").multiple
        > 100.0 * quiet.perfect.effect("air_drag_linear").multiple
    )
    tilt = loud.perfect.effect("gravity_tilt.tilt_x_rad")
    assert tilt.status == INVISIBLE and tilt.gates[0].plausible == 0.1


def test_a_motion_is_proposed_that_shows_what_a_still_recording_does_not() -> None:
    moving = bar()
    still = replace(moving, controllers=np.repeat(moving.controllers[:1], len(moving.times), axis=0))
    asked = replace(CONFIG, candidates=("actuation_lag", "measurement_drift"), motions=5, longest_s=0.7)
    told = check(still, asked)
    lag = told.usual.effect("actuation_lag")
    assert lag.status == INVISIBLE and lag.multiple == np.inf
    assert told.proposal is not None and told.proposal.motion not in (None, "hold")
    (shown,) = (change for change in told.proposal.shows if change.labels == ("actuation_lag",))
    assert shown.shown and "actuation_lag" in told.proposal.description
    assert told.proposal.controllers.shape == (len(told.proposal.times_s), 4, 3)


def test_a_number_that_is_not_there_and_a_noise_that_is_none_are_refused() -> None:
    with pytest.raises(ValueError, match=r"no 'bending_n_m2' to be calibrated; it has youngs_modulus_pa"):
        check(bar(), replace(CONFIG, values={"bending_n_m2": 1.0}))
    with pytest.raises(ValueError, match="not within"):
        check(bar(), replace(CONFIG, values={"youngs_modulus_pa": 1.0}))
    with pytest.raises(ValueError, match=r"noise of 0\.0 m"):
        check(bar(), replace(CONFIG, noise_m=0.0))
    with pytest.raises(ValueError, match="a share from 0 to 1"):
        check(bar(), replace(CONFIG, discrepancy_share=1.0))


def test_a_check_is_cancelled_between_simulations() -> None:
    with pytest.raises(Cancelled):
        check(bar(), CONFIG, cancelled=lambda: True)


def test_a_clamp_is_varied_both_ways_for_its_reach_has_a_kink() -> None:
    scene = bar()
    whole = replace(scene.grips[0], region_max_m=np.array([0.03, 0.015, 0.015]))
    told = check(replace(scene, grips=(whole,)), replace(CONFIG, candidates=("clamp_offset",)))
    probed = [unknown for unknown in told.physics.probed if unknown.name == "clamp_offset.reach_m"]
    assert [np.sign(unknown.step) for unknown in probed] == [1.0, -1.0]
    assert len([f for f in told.perfect.parameters if f.name == "clamp_offset.reach_m"]) == 1
