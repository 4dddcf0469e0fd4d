"""No free motion of the modal prior grows.

A passive body's motion does not grow of itself, a least-squares map of a few modes may: where some eigenvalue of

    [a^{t+1} … a^{t-h+1}] = C(ζ) [a^t … a^{t-h}]        first rows of C: weight + ζ response_1 + ζ² response_2

lies outside the unit circle, a session that runs longer than an episode blows up. Such eigenvalues are moved onto the
circle and the others stay: with the left eigenvectors U of those to be moved, Uᵀ C = Λ Uᵀ, the first rows less G Uᵀ
have the eigenvalues of Λ - Uᵀ_1 G in their place (Uᵀ_1: U's part in the first rows). G is the smallest that does it,
every mode measured by its size in the data (partial pole placement, Saad 1988). That is done at several ζ; polynomials
in ζ are laid through what was taken away, and it is repeated until none is left outside. What then
remains outside, and maps that are too far from stable for this, are shrunk: with A_k the weight of a^{t-k}, the maps
γ^{k+1} A_k have γ times the eigenvalues.

Legend: R modes, L = (h+1) R. NumPy only.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array

NODES = 7  # values of ζ over its span at which no motion may grow
ROUNDS = 8
MOST_GROWTH = 1.3  # beyond which eigenvalues are not moved one by one
MOST_CHANGE = 0.5  # of a weight, between modes of equal size; what would need more is shrunk
INSIDE = 1e-3  # distance from the circle that is aimed at


def growth(weight: Array, response: Array, zeta: float, history: int) -> float:
    """Largest factor by which a free motion of the modes grows in a step: the spectral radius of C(ζ).

    Args:
        weight: of lagged amplitudes and drives (R, F).
        response: their change by powers of ζ (2, R, L + 1).
        zeta: how soft the body is, as a mean of Φ.
        history: h.
    """
    return float(np.abs(np.linalg.eigvals(_companion(weight, response, zeta, history))).max())


def without_growth(
    weight: Array, response: Array, size: Array, span: tuple[float, float], history: int
) -> tuple[Array, Array]:
    """The map, weight (R, F) and response (2, R, L + 1), changed until no free motion grows for ζ within ``span``.

    Args:
        weight: of lagged amplitudes and drives (R, F).
        response: their change by powers of ζ (2, R, L + 1).
        size: root mean square amplitudes of the modes (R,), above 0.
        span: smallest and largest ζ.
        history: h.
    """
    zetas = np.linspace(*span, NODES) if response.any() else np.zeros(1)
    most = _most_growth(weight, response, zetas, history)
    if most <= 1.0:
        return weight, response
    weight, response = weight.copy(), response.copy()
    count, lags = len(weight), (history + 1) * len(weight)
    if most <= MOST_GROWTH:
        rows = np.tile(size, history + 1)
        powers = zetas[:, None] ** np.arange(len(response) + 1) if response.any() else np.ones((1, 1))
        for _ in range(ROUNDS):
            maps = [_companion(weight, response, zeta, history) for zeta in zetas]
            taken = np.array([_to_the_circle(each * rows / rows[:, None], count) for each in maps])
            if not taken.any() or np.abs(taken).max() > MOST_CHANGE:
                break
            parts, *_ = np.linalg.lstsq(powers, taken.reshape(len(zetas), -1), rcond=None)
            own, *answers = parts.reshape(-1, count, lags) * size[:, None] / rows
            weight[:, :lags] -= own
            for part, less in zip(response, answers, strict=False):
                part[:, :lags] -= less
        most = _most_growth(weight, response, zetas, history)
    if most > 1.0:
        shrink = np.repeat(most ** -np.arange(1.0, history + 2), count)
        weight[:, :lags] *= shrink
        response[:, :, :lags] *= shrink
    return weight, response


def _most_growth(weight: Array, response: Array, zetas: Array, history: int) -> float:
    return max(growth(weight, response, float(zeta), history) for zeta in zetas)


def _companion(weight: Array, response: Array, zeta: float, history: int) -> Array:
    """C(ζ), (L, L)."""
    count = len(weight)
    lags = (history + 1) * count
    companion = np.eye(lags, k=-count)
    companion[:count] = weight[:, :lags]
    for k, part in enumerate(response):
        companion[:count] += zeta ** (k + 1) * part[:, :lags]
    return companion


def _to_the_circle(companion: Array, count: int) -> Array:
    """What to take from the first ``count`` rows (R, L) so that eigenvalues outside the circle lie on it."""
    values, vectors = np.linalg.eig(companion.T)
    outside = np.abs(values) > 1.0
    if not outside.any():
        return np.zeros((count, len(companion)))
    left, moved = vectors[:, outside], values[outside]
    less = np.diag(moved - (1.0 - INSIDE) * moved / np.abs(moved))
    return np.real(np.linalg.pinv(left[:count].T) @ less @ left.T)
