"""Part-aware perturbation of physical properties: a Gaussian field over part features (paper, P3-Pert).

S_ij = exp(-|F_i - F_j|² / 2ℓ²), Σ = σ²S, δ ~ N(0, Σ); the properties are multiplied by exp(δ), so that they
stay positive. Where a length scale in space is given too, S_ij has the further factor exp(-|x_i - x_j|² / 2ℓ_x²).
Σ of all P particles is never formed: with m landmarks spread over feature space by farthest-point sampling,
C = S_{P,m} and W = S_{m,m} = UΛUᵀ, the Nyström approximation S ≈ C W⁻¹ Cᵀ has the factor C U Λ^{-1/2}, and
δ = σ C U Λ^{-1/2} ξ with ξ ~ N(0, I). Landmarks are doubled until they miss no more than a stated share of the
variance anywhere. The factor's rows are scaled to unit length: each particle keeps its variance σ² exactly; what
the landmarks do not resolve is a little more correlated.

Samples are bounded by 3σ and by a largest factor, smoothly: nothing changes in the inner two thirds. The baselines
of the paper's ablation are one draw for the whole body (``uniform``) and one for each particle (``random``).
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.errors import UnstableSimulation

KEEP_SHARE = 2.0 / 3.0  # of the bound: up to there samples are left alone
BOUND_SIGMAS = 3.0
EIGENVALUE_FLOOR = 1e-9  # relative; directions below it carry no variance and would only amplify rounding
MOST_LANDMARKS = 768
JUMP_SIGMAS = 6.0


def similarity(first: Array, second: Array, length_scale: float) -> Array:
    """S between features (A, F) and (B, F): (A, B) in (0, 1]."""
    squared = np.sum(first**2, axis=1)[:, None] + np.sum(second**2, axis=1)[None, :] - 2.0 * first @ second.T
    similarity: Array = np.exp(-np.maximum(squared, 0.0) / (2.0 * length_scale**2))
    return similarity


def with_space(features: Array, points: Array, length_scale: float, space_scale_m: float) -> Array:
    """Features (P, F + 3) whose kernel at ``length_scale`` is that of features times that of ``points`` (P, 3) [m].

    Args:
        features: of the particles, (P, F).
        points: their places at rest [m], (P, 3).
        length_scale: of the kernel over the features.
        space_scale_m: of the kernel over places [m].
    """
    if not space_scale_m > 0.0:
        raise ValueError(f"length scale in space {space_scale_m:g} m is not positive")
    return np.concatenate([features, points * (length_scale / space_scale_m)], axis=1)


class PropertyField:
    """The law N(0, S) over particles, ready to be sampled.

    Attributes:
        factor: (P, r) with factor @ factor.T ≈ S and a unit diagonal.
        landmarks: how many were taken.
        unresolved: largest 1 - diag(C W⁻¹ Cᵀ): the share of variance that the landmarks miss somewhere.

    Args:
        features: of the particles, (P, F).
        length_scale: of the kernel over the features, above 0.
        landmarks: how many to begin with; they are doubled until ``unresolved`` holds or they are ``MOST_LANDMARKS``.
        unresolved: share of variance that may be missed at one particle, 1 for any.

    Raises:
        ValueError: features that are not finite or not two-dimensional, or a length scale that is not positive.
    """

    def __init__(
        self, features: Array, length_scale: float, landmarks: int = 96, unresolved: float = 1.0
    ) -> None:
        features = np.asarray(features, dtype=np.float64)
        if features.ndim != 2 or not np.isfinite(features).all():
            raise ValueError(f"features of shape {features.shape} must be finite and two-dimensional")
        if not length_scale > 0.0:
            raise ValueError(f"length scale {length_scale:g} is not positive")
        while True:
            chosen = farthest_points(features, landmarks)
            between = similarity(features, features[chosen], length_scale)
            values, vectors = np.linalg.eigh(between[chosen])
            kept = values > EIGENVALUE_FLOOR * values[-1]
            factor = between @ (vectors[:, kept] / np.sqrt(values[kept]))
            norms = np.linalg.norm(factor, axis=1)
            self.unresolved = float(1.0 - np.min(norms) ** 2)
            self.landmarks = len(chosen)
            if self.unresolved <= unresolved or landmarks >= min(MOST_LANDMARKS, len(features)):
                break
            landmarks *= 2
        # A particle far from every landmark has a row of nearly zero length; the floor keeps the division finite.
        self.factor = factor / np.maximum(norms, 1e-6)[:, None]
        self._steps: tuple[Array, Array] | None = None

    def sample(self, generator: np.random.Generator) -> Array:
        """One draw of N(0, S), (P,)."""
        draw: Array = self.factor @ generator.standard_normal(self.factor.shape[1])
        return draw

    def step_sizes(self, pairs: Array) -> Array:
        """Standard deviation of δ_i - δ_j over σ for pairs (M, 2) of particles, (M,); kept for the same pairs."""
        if self._steps is None or self._steps[0] is not pairs:
            apart = np.linalg.norm(self.factor[pairs[:, 0]] - self.factor[pairs[:, 1]], axis=1)
            self._steps = pairs, apart
        return self._steps[1]


def bounded(values: Array, most: float = BOUND_SIGMAS) -> Array:
    """Values within ±``most``: identity up to two thirds of it, then a tanh that joins it with equal slope."""
    keep = KEEP_SHARE * most
    over = np.maximum(np.abs(values) - keep, 0.0)
    span = most - keep
    return np.where(over > 0.0, np.sign(values) * (keep + span * np.tanh(over / span)), values)


def perturb(
    kind: str,
    sigma: float,
    count: int,
    field: PropertyField | None,
    generator: np.random.Generator,
    largest_factor: float = np.inf,
) -> Array:
    """Log factors of one property, (P,) float64.

    Args:
        kind: ``p3`` (needs a ``field``), ``uniform``, ``random``, ``none``.
        sigma: standard deviation in the log, before the bound.
        count: P.
        largest_factor: bound of the factor and of its inverse.
    """
    if kind == "none" or sigma == 0.0:
        return np.zeros(count)
    if kind == "p3":
        if field is None:
            raise ValueError("a part-aware perturbation needs a field over part features")
        normal = field.sample(generator)
    elif kind == "uniform":
        normal = np.full(count, generator.standard_normal())
    elif kind == "random":
        normal = generator.standard_normal(count)
    else:
        raise ValueError(f"unknown perturbation {kind!r}")
    return bounded(sigma * normal, min(BOUND_SIGMAS * sigma, float(np.log(largest_factor))))


def check_field(
    values: Array,
    sigma: float,
    neighbours: Array,
    field: PropertyField | None,
    largest_factor: float = np.inf,
) -> float:
    """Refuse log factors (P,) that pass their bounds or jump; the root mean square step between neighbours, in σ.

    A field over features has E|δ_i - δ_j|² = 2σ²(1 - S_ij). A step of more than six of these standard deviations
    between ``neighbours`` (M, 2), pairs of particles side by side, does not belong to it.

    Args:
        values: natural logarithms of a property over its fitted value, (P,).
        sigma: their standard deviation.
        neighbours: indices of particles side by side, (M, 2).
        field: the Gaussian field that the values were drawn from; None: their steps are not checked.
        largest_factor: of a property over its fitted value.

    Raises:
        UnstableSimulation: with the numbers.
    """
    if not np.isfinite(values).all():
        raise UnstableSimulation(
            f"{int((~np.isfinite(values)).sum())} of {len(values)} properties are not finite"
        )
    most = min(BOUND_SIGMAS * sigma, float(np.log(largest_factor)))
    if float(np.abs(values).max(initial=0.0)) > most * (1.0 + 1e-9):
        raise UnstableSimulation(
            f"a property is exp({np.abs(values).max():.4f}) times its fitted value, the bound is exp({most:.4f})"
        )
    if sigma == 0.0 or not len(neighbours):
        return 0.0
    steps = values[neighbours[:, 0]] - values[neighbours[:, 1]]
    if field is not None:
        allowed = JUMP_SIGMAS * sigma * field.step_sizes(neighbours) + 1e-9
        if np.any(np.abs(steps) > allowed):
            worst = int(np.argmax(np.abs(steps) - allowed))
            raise UnstableSimulation(
                f"particles {neighbours[worst].tolist()} side by side differ by {abs(steps[worst]):.4f} in the log "
                f"of a property, {allowed[worst]:.4f} is the most that their features allow"
            )
    return float(np.sqrt(np.mean(steps**2)) / sigma)


def farthest_points(features: Array, count: int) -> Array:
    """Indices of ``count`` rows spread by farthest-point sampling from the one nearest the mean."""
    count = min(count, features.shape[0])
    first = int(np.argmin(np.sum((features - features.mean(axis=0)) ** 2, axis=1)))
    chosen = np.empty(count, dtype=np.int64)
    chosen[0] = first
    squared = np.sum((features - features[first]) ** 2, axis=1)
    for i in range(1, count):
        chosen[i] = int(np.argmax(squared))
        squared = np.minimum(squared, np.sum((features - features[chosen[i]]) ** 2, axis=1))
    return np.unique(chosen)
