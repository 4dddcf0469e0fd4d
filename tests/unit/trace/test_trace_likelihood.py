"""The likelihood of a trace against dense Gaussians, its posterior, and one trace from beginning to end."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from physworld.check.discrepancy import Block, Discrepancy
from physworld.estimation.unknowns import Unknown
from physworld.trace.answer import decided
from physworld.trace.likelihood import Linear, evidence, marginal
from physworld.trace.posterior import HALF, posterior, removes

SIGMA = 1e-3


def unknown(number: int) -> Unknown:
    return Unknown(f"u{number}", "1", -50.0, 50.0, lambda twin, value: twin, prior=(0.0, 2.0))


def at_the_optimum(measured, jacobian, discrepancy: Discrepancy, kappa: float) -> Linear:
    """The unknowns where a search under this discrepancy ends."""
    j, r = discrepancy.whitened(jacobian, kappa), discrepancy.whitened(measured, kappa)
    optimum = np.linalg.solve(j.T @ j + np.eye(2) / 4.0, j.T @ r)
    unknowns = [unknown(k).starting(t) for k, t in enumerate(optimum)]
    return Linear(measured - jacobian @ optimum, jacobian, unknowns, optimum)


@pytest.fixture
def known() -> tuple[Discrepancy, Linear, np.ndarray]:
    """Three blocks of ten rows with three directions of discrepancy each, two unknowns at their optimum; K (30, 30)."""
    rng = np.random.default_rng(3)
    blocks, dense = [], np.zeros((30, 30))
    for number in range(3):
        rows = np.arange(10 * number, 10 * number + 10)
        basis = np.linalg.qr(rng.normal(size=(10, 3)))[0]
        factors = np.array([900.0, 400.0, 100.0])
        blocks.append(Block(rows, basis, factors))
        dense[np.ix_(rows, rows)] = basis @ np.diag(factors**2) @ basis.T
    jacobian, residual = rng.normal(size=(30, 2)), 1.5 * rng.normal(size=30)
    optimum = np.linalg.solve(jacobian.T @ jacobian + np.eye(2) / 4.0, jacobian.T @ residual)
    unknowns = [unknown(k).starting(t) for k, t in enumerate(optimum)]
    linear = Linear(residual - jacobian @ optimum, jacobian, unknowns, optimum)
    return Discrepancy(tuple(blocks), SIGMA, 0.1), linear, dense


def test_whitening_is_the_inverse_root_of_the_covariance(known) -> None:
    discrepancy, linear, dense = known
    kappa = 2e-3
    whitened = discrepancy.whitened(linear.residual, kappa)
    inverse = np.linalg.inv(np.eye(30) + kappa**2 * dense)
    assert whitened @ whitened == pytest.approx(linear.residual @ inverse @ linear.residual)
    np.testing.assert_allclose(discrepancy.unwhitened(whitened, kappa), linear.residual, atol=1e-12)
    half = 0.5 * np.linalg.slogdet(np.eye(30) + kappa**2 * dense)[1]
    assert discrepancy.log_determinants(kappa).sum() == pytest.approx(half)


def test_the_marginal_likelihood_is_that_of_a_dense_gaussian(known) -> None:
    discrepancy, linear, dense = known
    measured = linear.residual + linear.jacobian @ linear.theta  # about unknowns of zero
    kappas = discrepancy.amplitudes()
    logs = []
    for kappa in kappas:
        covariance = np.eye(30) + kappa**2 * dense + 4.0 * linear.jacobian @ linear.jacobian.T
        logs.append(multivariate_normal(np.zeros(30), covariance).logpdf(measured))
    total = np.array(logs) + 15.0 * np.log(2 * np.pi) + discrepancy.log_prior(kappas)
    widths = np.concatenate([[kappas[1]], np.gradient(kappas[1:])])
    found, best = marginal(linear, discrepancy)
    assert found == pytest.approx(logsumexp(total + np.log(widths / widths.sum())), abs=1e-6)
    assert best == kappas[int(np.argmax(total))]


def test_a_left_out_block_has_the_density_of_a_dense_conditional_gaussian(known) -> None:
    discrepancy, linear, dense = known
    measured = linear.residual + linear.jacobian @ linear.theta
    linear = at_the_optimum(measured, linear.jacobian, discrepancy, evidence(linear, discrepancy).kappa)
    found = evidence(linear, discrepancy)
    covariance = np.eye(30) + found.kappa**2 * dense + 4.0 * linear.jacobian @ linear.jacobian.T
    for number, block in enumerate(discrepancy.blocks):
        own, rest = block.rows, np.setdiff1d(np.arange(30), block.rows)
        gain = covariance[np.ix_(own, rest)] @ np.linalg.inv(covariance[np.ix_(rest, rest)])
        mean = gain @ measured[rest]
        spread = covariance[np.ix_(own, own)] - gain @ covariance[np.ix_(rest, own)]
        expected = multivariate_normal(mean, spread).logpdf(measured[own]) + 5.0 * np.log(2 * np.pi)
        assert found.left_out[number] == pytest.approx(expected, rel=1e-5)


def test_a_discrepancy_is_found_where_there_is_one_and_only_there(known) -> None:
    discrepancy, _, dense = known
    rng = np.random.default_rng(0)
    sizes = {}
    for kappa in (0.0, 2e-2):
        root = np.linalg.cholesky(np.eye(30) + kappa**2 * dense)
        drawn = [root @ rng.normal(size=30) for _ in range(40)]
        sizes[kappa] = [
            marginal(Linear(r, np.zeros((30, 0)), [], np.zeros(0)), discrepancy)[1] for r in drawn
        ]
    assert np.median(sizes[0.0]) <= 0.5 * SIGMA
    assert 1e-2 < np.median(sizes[2e-2]) < 4e-2


def test_a_posterior_prefers_what_predicts_and_what_is_simple() -> None:
    rng = np.random.default_rng(1)
    plain = -100.0 + rng.normal(size=12)
    weights = posterior([plain, plain + 5.0, plain + 5.0], [0, 1, 1], 20)
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(weights, [0.0, 0.5, 0.5], atol=1e-6)
    same = posterior([plain, plain], [0, 1], 20)
    np.testing.assert_allclose(same, [40.0 / 41.0, 1.0 / 41.0])


def test_what_wins_in_one_block_only_does_not_win_for_sure() -> None:
    plain = np.full(12, -100.0)
    once = plain.copy()
    once[3] += 30.0
    assert posterior([plain, plain + 30.0 / 12.0], [0, 0], 20)[1] > 0.999
    assert posterior([plain, once - 0.5], [0, 0], 20)[1] < 0.999


def test_an_effect_removes_a_share_of_what_is_above_the_noise() -> None:
    assert removes(3.0, 2.0) == HALF
    assert removes(3.0, 0.9) == 1.0
    assert removes(1.04, 1.0) == 0.0, "that much is not known of the noise"


@pytest.mark.slow
def test_a_trace_names_a_drag_and_tells_what_is_left() -> None:
    from test_trace_run import CONFIG, beam, recorded

    from physworld.effects.registry import effect
    from physworld.trace import document, trace

    config = replace(CONFIG, experiment=None)
    found = trace(recorded(beam(0.03), effect("air_drag_linear", rate_per_s=6.0)), config)
    report = document(found)
    assert found.verdict.name == "named" and [e.name for e in found.effects] == ["air_drag_linear"]
    assert found.effects[0].parameters["rate_per_s"].value == pytest.approx(6.0, rel=0.2)
    assert report["effects"][0]["posterior"] > 0.95
    assert 0.5 < report["effects"][0]["share_of_held_out_error"] <= 1.0
    assert report["remainder"]["over_noise"] < 1.3
    assert sum(h["posterior"] for h in report["hypotheses"]) == pytest.approx(1.0)


@pytest.mark.slow
def test_a_trace_names_nothing_where_nothing_acts() -> None:
    from test_trace_run import CONFIG, SIGMA, beam, recorded

    from physworld.trace import trace

    found = trace(recorded(beam(0.015), sigma=2 * SIGMA), replace(CONFIG, experiment=None))
    assert found.verdict.name == "nothing_to_explain" and not found.effects


@pytest.mark.parametrize(
    ("weights", "name"),
    [([0.0, 0.01, 0.99], "unexplained"), ([0.0, 0.94, 0.06], "named"), ([0.06, 0.94, 0.0], "unexplained")],
)
def test_no_other_name_is_given_where_something_unbelievable_predicts_best(
    weights: list[float], name: str
) -> None:
    def known(effect: str | None, misfit: float, doubt: str | None = None) -> Any:
        members = () if effect is None else (SimpleNamespace(effect=effect, kind="force"),)
        seen = SimpleNamespace(kappa=0.0, errors=np.ones(2), sizes=np.ones(2))
        names = tuple(member.effect for member in members)
        fitted = SimpleNamespace(misfit=misfit)
        return SimpleNamespace(members=members, names=names, fitted=fitted, evidence=seen, doubt=doubt)

    gale = known("wind", 1.0, "a wind of 60 m/s is not believed")
    hypotheses = [known(None, 4.0), known("air_drag_linear", 1.1), gale]
    found = decided(hypotheses, np.array(weights), 1e-3, {}, 20)
    assert found.name == name and not found.equivalent
    assert ("not believed" in found.reason) == (weights[2] > 0.9)
