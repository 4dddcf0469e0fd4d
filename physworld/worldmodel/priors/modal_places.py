"""Where on the body stiffness and density tell in its motion: the weights that make one number ζ of the field Φ.

A beam that is clamped at one end rings faster where it is stiff at the root or light at the tip; a mean over the body
knows neither. Rayleigh's quotient says that a frequency answers to log(E) place by place with the share of its strain
energy there, and to log(ρ) with that of its kinetic energy. Those shares are found from the episodes instead of from
a mode's energies. For every episode, the ζ at which a prior of few modes errs least in open loop is what the body's
ratio of stiffness to density amounted to. These numbers are regressed on the fields Φ (kernel ridge regression towards
the mean over the body, weighted by how sharply the error knows each; its ridge by leaving each episode out), and the
prior is fitted again with the ζ that come of it, as long as it errs less with them. Where leaving out says that they
cannot be predicted better than by the mean over the body, that stays. A homogeneous change counts in full.

Legend: E episodes, n object vertices, R modes. NumPy only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from physworld.arrays import Array
from physworld.worldmodel.priors.modal_poles import without_growth
from physworld.worldmodel.priors.modal_regression import Choice, Seen, errors, grams_of, regress, scale_of

FEWEST = 8  # episodes
LEAST_SPREAD = 1e-3  # of ζ over the episodes
LEAST_WHOLE = 0.25  # share of a homogeneous change that counts, from which on it counts as one
ROUNDS = 3
MODES, RIDGE = 6, 1e-3
TRIALS, REACH = 25, 4.0  # values of ζ that are tried, over so many standard deviations
RIDGES = 10.0 ** np.arange(-4.0, 3.5, 0.5)  # over the mean of the kernel's diagonal


def mean_placing(n: int) -> Array:
    """The mean over the body of log stiffness less log density, (n, 2)."""
    return np.tile([1.0 / n, -1.0 / n], (n, 1))


def find_places(seen: list[Seen], fields: Array, size: Array, history: int) -> Array:
    """Where each episode's Φ softens the modes: ``placing`` (n, 2), whose product with Φ is ζ.

    Args:
        seen: the episodes' amplitudes.
        fields: their Φ (E, n, 2).
        size: root mean square amplitudes of the modes (R,), above 0.
        history: h.
    """
    n = fields.shape[1]
    uniform = mean_placing(n)
    flat = fields.reshape(len(fields), -1)
    means = flat @ uniform.ravel()
    if len(seen) < FEWEST or means.std() < LEAST_SPREAD:
        return uniform
    modes = min(MODES, seen[0].amplitudes.shape[1])
    few = [s.of(modes) for s in seen]
    scale, choice = scale_of(few, size[:modes], history), Choice(modes, RIDGE, RIDGE)
    trials = means.mean() + means.std() * np.linspace(-REACH, REACH, TRIALS)
    placing, least, proposed = uniform, np.inf, uniform
    for _ in range(ROUNDS + 1):
        zeta = flat @ proposed.ravel()
        few = [replace(s, softness=float(value)) for s, value in zip(few, zeta, strict=True)]
        fitted = regress(grams_of(few, scale, history), scale, choice, modes, history)
        span = (min(0.0, zeta.min()), max(0.0, zeta.max()))
        fitted = without_growth(*fitted, size[:modes], span, history)
        error = float(errors(*fitted, few, zeta, history).mean())
        if error >= least:
            break
        placing, least = proposed, error
        best, known = _best_softness(*fitted, few, trials, history)
        found = _ridge(flat, best - means, known)
        if found is None:
            break
        proposed = uniform + found.reshape(n, 2)
        proposed = proposed * (means.std() / (flat @ proposed.ravel()).std())  # its unit is free
    whole = 0.5 * float(placing[:, 0].sum() - placing[:, 1].sum())
    return placing / whole if whole > LEAST_WHOLE else placing


def _best_softness(
    weight: Array, response: Array, seen: list[Seen], trials: Array, history: int
) -> tuple[Array, Array]:
    """The ζ (E,) with the least error of every episode, and the curvature of the squared error there."""
    tried = [errors(weight, response, seen, np.full(len(seen), z), history) ** 2 for z in trials]
    square = np.minimum(tried, np.finfo(float).max / 16)
    middle = np.clip(square.argmin(axis=0), 1, len(trials) - 2)
    rows, step = np.arange(len(seen)), trials[1] - trials[0]
    low, here, high = (square[middle + k, rows] for k in (-1, 0, 1))
    bend = np.maximum(low - 2.0 * here + high, np.finfo(float).tiny)
    return trials[middle] + step * np.clip(0.5 * (low - high) / bend, -1.0, 1.0), bend / step**2


def _ridge(flat: Array, offset: Array, known: Array) -> Array | None:
    """Weights (2n,) with flat · weights ≈ offset (E,), rows weighted by ``known``; None where nothing is predicted."""
    rows = np.sqrt(known / known.mean())
    inputs, target = rows[:, None] * flat, rows * offset
    kernel = inputs @ inputs.T
    values, vectors = np.linalg.eigh(kernel)
    values = np.maximum(values, 0.0)
    least, chosen = float(np.mean(target**2)), None
    for ridge in RIDGES * values.mean():
        solved = vectors @ ((vectors.T @ target) / (values + ridge))
        left = solved / ((vectors**2) @ (1.0 / (values + ridge)))  # what each misses when it is left out
        missed = float(np.mean(left**2))
        if missed < least:
            least, chosen = missed, inputs.T @ solved
    return chosen
