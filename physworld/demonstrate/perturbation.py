"""Part-aware perturbation of physical properties: a Gaussian field over part features (paper, P3-Pert).

S_ij = exp(-|F_i - F_j|² / 2ℓ²), Σ = σ²S, δ ~ N(0, Σ); the properties are multiplied by exp(δ), so that they
stay positive. Σ of all P particles is never formed: with m landmarks spread over feature space by
farthest-point sampling, C = S_{P,m} and W = S_{m,m} = UΛUᵀ, the Nyström approximation S ≈ C W⁻¹ Cᵀ has the
factor C U Λ^{-1/2}, and δ = σ C U Λ^{-1/2} ξ with ξ ~ N(0, I). Its rows are scaled to unit length: each
particle keeps its variance σ² exactly; what the landmarks do not resolve is a little more correlated.

Samples are bounded by 3σ, smoothly: nothing changes below 2σ.
"""

from __future__ import annotations

import numpy as np

KEEP_SIGMAS = 2.0
BOUND_SIGMAS = 3.0
EIGENVALUE_FLOOR = 1e-9  # relative; directions below it carry no variance and would only amplify rounding


def similarity(first: np.ndarray, second: np.ndarray, length_scale: float) -> np.ndarray:
    """S between features (A, F) and (B, F): (A, B) in (0, 1]."""
    squared = np.sum(first**2, axis=1)[:, None] + np.sum(second**2, axis=1)[None, :] - 2.0 * first @ second.T
    return np.exp(-np.maximum(squared, 0.0) / (2.0 * length_scale**2))


class PropertyField:
    """The law N(0, S) over particles, ready to be sampled.

    Attributes:
        factor: (P, r) with factor @ factor.T ≈ S and a unit diagonal.
        unresolved: largest 1 - diag(C W⁻¹ Cᵀ): the share of variance that the landmarks miss somewhere.
    """

    def __init__(self, features: np.ndarray, length_scale: float, landmarks: int = 96) -> None:
        features = np.asarray(features, dtype=np.float64)
        if features.ndim != 2 or not np.isfinite(features).all():
            raise ValueError(f"features of shape {features.shape} must be finite and two-dimensional")
        if not length_scale > 0.0:
            raise ValueError(f"length scale {length_scale:g} is not positive")
        chosen = farthest_points(features, landmarks)
        between = similarity(features, features[chosen], length_scale)
        values, vectors = np.linalg.eigh(between[chosen])
        kept = values > EIGENVALUE_FLOOR * values[-1]
        factor = between @ (vectors[:, kept] / np.sqrt(values[kept]))
        norms = np.linalg.norm(factor, axis=1)
        self.unresolved = float(1.0 - np.min(norms) ** 2)
        # A particle far from every landmark has a row of nearly zero length; m ≥ the number of such islands
        # in practice, and the floor keeps the division finite where it is not.
        self.factor = factor / np.maximum(norms, 1e-6)[:, None]

    def sample(self, generator: np.random.Generator) -> np.ndarray:
        """One draw of N(0, S), (P,)."""
        return self.factor @ generator.standard_normal(self.factor.shape[1])


def bounded(values: np.ndarray) -> np.ndarray:
    """Standard-normal values within ±3: identity up to ±2, then a tanh that joins it with equal slope."""
    over = np.maximum(np.abs(values) - KEEP_SIGMAS, 0.0)
    span = BOUND_SIGMAS - KEEP_SIGMAS
    return np.where(over > 0.0, np.sign(values) * (KEEP_SIGMAS + span * np.tanh(over / span)), values)


def perturb_properties(
    features: np.ndarray,
    generator: np.random.Generator,
    *,
    sigma_modulus: float,
    sigma_density: float,
    length_scale: float = 1.0,
    landmarks: int = 96,
) -> np.ndarray:
    """log(E/E_fit) and log(ρ/ρ_fit) per particle, (P, 2) float64; the two fields are independent.

    Args:
        features: part features (P, F) of unit RMS distance (``geometry.features``).
        sigma_modulus, sigma_density: standard deviations in the log.
        length_scale: ℓ in the same unit: 1 is the distance of two random particles.
    """
    field = PropertyField(features, length_scale, landmarks)
    return np.stack(
        [
            sigma_modulus * bounded(field.sample(generator)),
            sigma_density * bounded(field.sample(generator)),
        ],
        axis=1,
    )


def farthest_points(features: np.ndarray, count: int) -> np.ndarray:
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
