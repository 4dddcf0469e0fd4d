"""The modal prior finds a linear motion as it is, knows where stiffness counts, and none of its free motions grows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from physworld.worldmodel.priors.modal import ModalPrior, fit_prior
from physworld.worldmodel.priors.modal_places import mean_placing
from physworld.worldmodel.priors.modal_poles import growth, without_growth

FRAMES, HISTORY, VERTICES = 40, 2, 4
OMEGA = 0.4  # radians a step
LEVER = np.linspace(0.25, 1.0, VERTICES) ** 2


def rest() -> np.ndarray:
    """Four vertices in a row and a grip, (5, 3)."""
    return np.concatenate([np.linspace(0.05, 0.2, VERTICES), [0.0]])[:, None] * np.array([1.0, 0.0, 0.0])


def swinging(amplitude: np.ndarray) -> np.ndarray:
    """Tracks (T, 5, 3) of a row that swings about a resting grip, tip amplitude (T,)."""
    return rest() + amplitude[:, None, None] * np.append(LEVER, 0.0)[:, None] * np.array([0.0, 0.0, 0.02])


def episodes(factor: float, noise_m: float = 0.0) -> list[np.ndarray]:
    """It swings with ``factor`` per step, at five phases."""
    rng = np.random.default_rng(0)
    t = np.arange(FRAMES)
    tracks = [swinging(factor**t * np.cos(OMEGA * t + phase)) for phase in (0.0, 1.0, 2.0, 3.0, 4.0)]
    return [track + noise_m * rng.standard_normal(track.shape) for track in tracks]


def prior_of(tracks: list[np.ndarray], softnesses: list[float]) -> ModalPrior:
    phis = [np.full((VERTICES, 2), (zeta, 0.0)) for zeta in softnesses]
    return fit_prior(tracks, phis, VERTICES, HISTORY, 6)


def held_at_the_root(count: int, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Rows whose frequency answers to stiffness at the first vertex and to density at the last, and their Φ."""
    rng = np.random.default_rng(seed)
    phis = [rng.normal(0.0, 0.15, (VERTICES, 2)) for _ in range(count)]
    t = np.arange(FRAMES)
    pace = [OMEGA * np.exp(0.5 * (phi[0, 0] - phi[-1, 1])) for phi in phis]
    return [swinging(np.cos(omega * t + k)) for k, omega in enumerate(pace)], phis


def error_m(prior: ModalPrior, track: np.ndarray, phi: np.ndarray) -> float:
    """Root mean square error in open loop; the grip rests at the origin."""
    zeta = float(np.clip(np.sum(prior.placing * phi), *prior.span))
    flat = (track[:, :VERTICES] - prior.mean).reshape(len(track), -1)
    path = list((flat @ prior.basis.reshape(len(prior.basis), -1).T)[: HISTORY + 1])
    lags = (HISTORY + 1) * len(prior.basis)
    still = np.zeros(prior.weight.shape[1] - lags)
    still[-1] = 1.0
    for _ in range(len(track) - HISTORY - 1):
        past = np.concatenate(path[: -HISTORY - 2 : -1])
        answers = prior.response @ np.append(past, 1.0)
        path.append(prior.weight @ np.concatenate([past, still]) + zeta * answers[0] + zeta**2 * answers[1])
    gone = np.array(path) @ prior.basis.reshape(len(prior.basis), -1) - flat
    return float(np.sqrt(np.mean(gone**2)))


def test_arrays_that_do_not_fit_are_refused() -> None:
    prior = prior_of(episodes(0.97), [0.0] * 5)
    with pytest.raises(ValueError, match=r"6 modes of 4 vertices, but .* response \(6, 19\)"):
        replace(prior, response=prior.response[0])


def test_a_motion_that_dies_out_keeps_its_decay() -> None:
    prior = prior_of(episodes(0.97), [0.0] * 5)
    assert growth(prior.weight, prior.response, 0.0, HISTORY) == pytest.approx(0.97, abs=2e-3)


@pytest.mark.parametrize("factor", [1.02, 1.2])
def test_no_free_motion_grows(factor: float) -> None:
    softnesses = [-0.3, 0.2, 0.1, -0.2, 0.05]
    prior = prior_of(episodes(factor, noise_m=1e-3), softnesses)
    worst = max(growth(prior.weight, prior.response, zeta, HISTORY) for zeta in np.linspace(*prior.span, 7))
    assert worst < 1.0 + 1e-6
    assert worst > 0.95  # shrunk no more than it takes


@pytest.mark.parametrize("pair", [(1.1, 1.1), (1.05 + 0.2j, 1.05 - 0.2j)])
def test_only_what_grows_is_changed(pair: tuple[complex, complex]) -> None:
    kept = [0.9, 0.5, 0.3 + 0.4j, 0.3 - 0.4j]
    rows = [np.real(np.poly(poles)) for poles in ([pair[0], *kept[:2]], [pair[1], *kept[2:]])]
    if isinstance(pair[0], complex):
        rows = [np.real(np.poly([*pair, kept[0]])), np.real(np.poly([kept[1], *kept[2:]]))]
    weight = np.zeros((2, 7))
    for mode, row in enumerate(rows):
        weight[mode, mode:6:2] = -row[1:]
    changed, response = without_growth(weight, np.zeros((2, 2, 7)), np.ones(2), (0.0, 0.0), HISTORY)
    companion = np.eye(6, k=-2)
    companion[:2] = changed[:, :6]
    found = np.linalg.eigvals(companion)
    for pole in kept:
        assert np.abs(found - pole).min() < 1e-6
    assert np.sort(np.abs(found))[-2:] == pytest.approx([0.999, 0.999], abs=1e-3)
    assert not response.any()
    assert np.array_equal(changed[:, 6], weight[:, 6])


def test_what_is_far_from_stable_is_shrunk() -> None:
    weight = np.array([[2.0, -0.3, 0.05, 1.0]])
    changed, _ = without_growth(weight, np.zeros((2, 1, 4)), np.ones(1), (0.0, 0.0), HISTORY)
    assert growth(changed, np.zeros((2, 1, 4)), 0.0, HISTORY) == pytest.approx(1.0, abs=1e-9)


def test_growth_is_that_of_the_free_motion() -> None:
    weight = np.array([[1.1, -0.3, 0.05]])
    response = np.array([[[0.2, 0.0, 0.0, 0.0]], [[0.1, 0.0, 0.0, 0.0]]])
    past = [1.0, 0.5, 0.25]
    for _ in range(200):
        answer = 0.5 * response[0, 0, :3] @ past + 0.25 * response[1, 0, :3] @ past
        past = [float(weight[0] @ past + answer), *past[:2]]
    assert past[0] / past[1] == pytest.approx(growth(weight, response, 0.5, HISTORY), rel=1e-6)


def test_the_prior_knows_where_stiffness_and_density_count() -> None:
    prior = fit_prior(*held_at_the_root(40, seed=0), VERTICES, HISTORY, 6)
    assert prior.placing[0, 0] == pytest.approx(1.0, abs=0.15)
    assert prior.placing[-1, 1] == pytest.approx(-1.0, abs=0.15)
    elsewhere = np.concatenate([prior.placing[1:, 0], prior.placing[:-1, 1]])
    assert np.abs(elsewhere).max() < 0.1
    tracks, phis = held_at_the_root(10, seed=1)
    placed = np.mean([error_m(prior, track, phi) for track, phi in zip(tracks, phis, strict=True)])
    swing = np.mean([np.sqrt(np.mean((track - rest())[:, :VERTICES] ** 2)) for track in tracks])
    assert placed < 0.1 * swing


def test_without_a_field_that_varies_the_mean_over_the_body_counts() -> None:
    tracks, phis = held_at_the_root(12, seed=0)
    same = [np.zeros_like(phi) for phi in phis]
    assert np.array_equal(fit_prior(tracks, same, VERTICES, HISTORY, 6).placing, mean_placing(VERTICES))
    few = fit_prior(tracks[:5], phis[:5], VERTICES, HISTORY, 6)
    assert np.array_equal(few.placing, mean_placing(VERTICES))


def test_a_field_that_says_nothing_leaves_the_mean() -> None:
    tracks, _ = held_at_the_root(30, seed=0)
    rng = np.random.default_rng(7)
    idle = [rng.normal(0.0, 0.15, (VERTICES, 2)) for _ in tracks]
    prior = fit_prior(tracks, idle, VERTICES, HISTORY, 6)
    assert np.abs(prior.placing - mean_placing(VERTICES)).max() < 0.4
