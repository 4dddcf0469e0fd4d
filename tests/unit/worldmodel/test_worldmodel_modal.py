"""The modal prior finds a linear motion as it is, and none of its free motions grows."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.worldmodel.modal import ModalPrior, fit_prior, growth

FRAMES, HISTORY, VERTICES = 40, 2, 4
OMEGA = 0.4  # radians a step


def episodes(factor: float, noise_m: float = 0.0) -> list[np.ndarray]:
    """Tracks (T, 5, 3): four vertices in a row swing about a resting grip with ``factor`` per step, at five phases."""
    rng = np.random.default_rng(0)
    t = np.arange(FRAMES)
    rest = np.concatenate([np.linspace(0.05, 0.2, VERTICES), [0.0]])[:, None] * np.array([1.0, 0.0, 0.0])
    shape = np.concatenate([np.linspace(0.25, 1.0, VERTICES) ** 2, [0.0]])[:, None] * np.array(
        [0.0, 0.0, 0.02]
    )
    swing = [factor**t * np.cos(OMEGA * t + phase) for phase in (0.0, 1.0, 2.0, 3.0, 4.0)]
    tracks = [rest + a[:, None, None] * shape for a in swing]
    return [track + noise_m * rng.standard_normal(track.shape) for track in tracks]


def prior_of(tracks: list[np.ndarray], softnesses: list[float]) -> ModalPrior:
    phis = [np.full((VERTICES, 2), (zeta, 0.0)) for zeta in softnesses]
    return fit_prior(tracks, phis, VERTICES, HISTORY, 6)


def test_a_motion_that_dies_out_keeps_its_decay() -> None:
    prior = prior_of(episodes(0.97), [0.0] * 5)
    assert growth(prior.weight, prior.response, 0.0, HISTORY) == pytest.approx(0.97, abs=2e-3)


@pytest.mark.parametrize("factor", [1.02, 1.2])
def test_no_free_motion_grows(factor: float) -> None:
    softnesses = [-0.3, 0.2, 0.1, -0.2, 0.05]
    prior = prior_of(episodes(factor, noise_m=1e-3), softnesses)
    worst = max(growth(prior.weight, prior.response, zeta, HISTORY) for zeta in (-0.3, 0.0, 0.2))
    assert worst < 1.0 + 1e-6
    assert worst > 0.95  # shrunk no more than it takes


def test_growth_is_that_of_the_free_motion() -> None:
    weight, response = np.array([[1.1, -0.3, 0.05]]), np.array([[0.2, 0.0, 0.0, 0.0]])
    past = [1.0, 0.5, 0.25]
    for _ in range(200):
        past = [float(weight[0] @ past + 0.5 * response[0, :3] @ past), *past[:2]]
    assert past[0] / past[1] == pytest.approx(growth(weight, response, 0.5, HISTORY), rel=1e-6)
