"""The discrepancy of a check, and the marginal likelihood that its trials use, against dense Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from benchmarks.trace.marginal import amplitudes, log_prior, marginal
from physworld.check.discrepancy import Block, Discrepancy
from physworld.estimation.left_out import Linear
from physworld.estimation.unknowns import Unknown

SIGMA = 1e-3


def unknown(number: int) -> Unknown:
    return Unknown(f"u{number}", "1", -50.0, 50.0, lambda twin, value: twin, prior=(0.0, 2.0))


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


def test_the_marginal_likelihood_is_that_of_a_dense_gaussian(known) -> None:
    discrepancy, linear, dense = known
    measured = linear.residual + linear.jacobian @ linear.theta  # about unknowns of zero
    kappas = amplitudes(discrepancy)
    logs = []
    for kappa in kappas:
        covariance = np.eye(30) + kappa**2 * dense + 4.0 * linear.jacobian @ linear.jacobian.T
        logs.append(multivariate_normal(np.zeros(30), covariance).logpdf(measured))
    total = np.array(logs) + 15.0 * np.log(2 * np.pi) + log_prior(discrepancy, kappas)
    widths = np.concatenate([[kappas[1]], np.gradient(kappas[1:])])
    found, best = marginal(linear, discrepancy)
    assert found == pytest.approx(logsumexp(total + np.log(widths / widths.sum())), abs=1e-6)
    assert best == kappas[int(np.argmax(total))]


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
