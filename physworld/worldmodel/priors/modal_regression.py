"""The ridge regression under the modal prior, from normal equations, and its error in open loop.

A step's regressors are [past L, drive D, ζ past L, ζ, ζ² past L, ζ²] for all modes; those of fewer modes are a part of
them, so that one set of normal equations serves every choice.

Legend: as in :mod:`physworld.worldmodel.priors.modal`; G regressors in all, E episodes. NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array

SCALE_FLOOR = 1e-3  # of the largest: what hardly moves must not get a large weight
POWERS = 2  # of ζ


@dataclass(frozen=True)
class Seen:
    """An episode: amplitudes (T, R), what the grips do (T-1-h, D), ζ."""

    amplitudes: Array
    drive: Array
    softness: float


@dataclass(frozen=True)
class Choice:
    """How many modes, and ridges per row; an infinite ``response_ridge`` leaves the response out."""

    modes: int
    ridge: float
    response_ridge: float


@dataclass(frozen=True)
class Grams:
    """Normal equations, summed over episodes: ``inputs`` (G, G), ``targets`` (G, R), ``rows``: steps in them."""

    inputs: Array
    targets: Array
    rows: int

    def without(self, other: Grams) -> Grams:
        """What is left when ``other``'s episodes are taken away."""
        return Grams(self.inputs - other.inputs, self.targets - other.targets, self.rows - other.rows)


def grams_of(seen: list[Seen], scale: Array, history: int) -> Grams:
    """The normal equations of episodes, regressors divided by ``scale`` (G,)."""
    inputs = np.zeros((len(scale), len(scale)))
    targets, rows = np.zeros((len(scale), seen[0].amplitudes.shape[1])), 0
    for s in seen:
        past = _past(s.amplitudes, history)
        answer = np.append(past, np.ones((len(past), 1)), axis=1)
        powers = [s.softness**k * answer for k in range(1, POWERS + 1)]
        given = np.concatenate([past, s.drive, *powers], axis=1) / scale
        inputs += given.T @ given
        targets += given.T @ s.amplitudes[history + 1 :]
        rows += len(given)
    return Grams(inputs, targets, rows)


def scale_of(seen: list[Seen], size: Array, history: int) -> Array:
    """Sizes of the regressors (G,): their spread, not below a share of the largest; ``size`` (R,) of the modes."""
    spread = np.concatenate([s.drive for s in seen]).std(axis=0)
    lagged = np.tile(size, history + 1)
    drive = np.maximum(spread, max(SCALE_FLOOR * spread.max(), lagged.min()))
    drive[-1] = 1.0
    return np.concatenate([lagged, drive, *[np.append(lagged, 1.0)] * POWERS])


def regress(grams: Grams, scale: Array, choice: Choice, modes: int, history: int) -> tuple[Array, Array]:
    """Ridge regression of the next amplitudes: weight (R, F) and response (2, R, L + 1) of ``choice``.

    ``modes``: how many the normal equations have.
    """
    block = (history + 1) * modes + 1
    lags = np.concatenate([np.arange(choice.modes) + k * modes for k in range(history + 1)])
    first = len(scale) - POWERS * block
    drive = np.arange(block - 1, first)
    powers = [np.append(lags, block - 1) + first + k * block for k in range(POWERS)]
    respond = np.isfinite(choice.response_ridge)
    taken = np.concatenate([lags, drive, *(powers if respond else [])]).astype(int)
    own, answers = len(lags) + len(drive), len(lags) + 1
    penalties = np.full(len(taken), choice.ridge)
    penalties[own:] = choice.response_ridge
    system = grams.inputs[np.ix_(taken, taken)] + grams.rows * np.diag(penalties)
    solution = np.linalg.solve(system, grams.targets[taken, : choice.modes]).T / scale[taken]
    response = np.zeros((POWERS, choice.modes, answers))
    if respond:
        response[:] = solution[:, own:].reshape(choice.modes, POWERS, answers).transpose(1, 0, 2)
    return solution[:, :own], response


def errors(weight: Array, response: Array, judged: list[Seen], softness: Array, history: int) -> Array:
    """Root mean square error of all amplitudes in open loop, by episode, (E,).

    Those beyond the R fitted are predicted as 0. ``softness`` (E,): the ζ at which each is predicted. Infinite where a
    prediction left the numbers.
    """
    count, lags = len(weight), (history + 1) * len(weight)
    zeta = softness[:, None]
    frames = max(len(s.amplitudes) for s in judged)
    path = np.zeros((frames, len(judged), count))
    driven = np.zeros((frames, len(judged), count))
    for k, s in enumerate(judged):
        path[: history + 1, k] = s.amplitudes[: history + 1, :count]
        driven[history + 1 : len(s.amplitudes), k] = s.drive @ weight[:, lags:].T
    maps = np.concatenate([weight[:, :lags], *response[:, :, :lags]]).T
    for k, part in enumerate(response):
        driven += zeta ** (k + 1) * part[:, -1]
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(history, frames - 1):
            past = path[t - history : t + 1][::-1].transpose(1, 0, 2).reshape(len(judged), lags)
            own, *answers = np.split(past @ maps, len(response) + 1, axis=1)
            path[t + 1] = own + driven[t + 1]
            for k, answer in enumerate(answers):
                path[t + 1] += zeta ** (k + 1) * answer
        found = np.empty(len(judged))
        for k, s in enumerate(judged):
            gap = path[: len(s.amplitudes), k] - s.amplitudes[:, :count]
            square = (gap**2).sum(axis=1) + (s.amplitudes[:, count:] ** 2).sum(axis=1)
            found[k] = np.sqrt(square.mean())
    return np.where(np.isfinite(found), found, np.inf)


def _past(amplitudes: Array, history: int) -> Array:
    """[a^t … a^{t-h}] for t = h … T-2."""
    t = np.arange(history, len(amplitudes) - 1)
    return np.concatenate([amplitudes[t - lag] for lag in range(history + 1)], axis=1)
