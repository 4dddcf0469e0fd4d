"""The ridge regression under the modal prior, from normal equations, and its error in open loop.

A step's regressors are [past L, drive D, ζ past L, ζ, ζ² past L, ζ²] for all modes; those of fewer modes are a part of
them, so that one set of normal equations serves every choice. In a grip's frame (``physworld.worldmodel.model.frame``)
the past of a step is seen from how the grips are turned at its end: ``lagged`` holds it, and in open loop the modes are
turned from step to step, with Q = R_{t+2}ᵀ R_{t+1} and B the basis:

    a' = B (Q (mean + Bᵀ a) - mean)

Legend: as in :mod:`physworld.worldmodel.priors.modal`; G regressors in all, E episodes. NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array

SCALE_FLOOR = 1e-3  # of the largest: what hardly moves must not get a large weight
POWERS = 2  # of ζ


@dataclass(frozen=True)
class Turning:
    """What turns modes: ``products`` (3, 3, R, R), B_k B_lᵀ of the basis's components; ``means`` (3, 3, R), B_k mean_l;
    ``rest`` (R,), B mean."""

    products: Array
    means: Array
    rest: Array

    def turned(self, amplitudes: Array, turns: Array) -> Array:
        """Amplitudes (E, h+1, R) turned by Q (E, 3, 3)."""
        count = amplitudes.shape[2]
        maps = np.tensordot(turns, self.products[:, :, :count, :count], axes=2)
        constant = np.tensordot(turns, self.means[:, :, :count], axes=2) - self.rest[:count]
        seen: Array = np.matmul(amplitudes, maps.transpose(0, 2, 1)) + constant[:, None]
        return seen


@dataclass(frozen=True)
class Seen:
    """An episode: amplitudes (T, R), what the grips do (T-1-h, D), ζ.

    In a grip's frame each amplitude is seen from its own moment's; ``lagged`` (T-1-h, h+1, R): the past of every step
    from the frame at its end, newest first; ``turns`` (T-1-h, 3, 3): Q from a step's frame to the next one's;
    ``turning``: of the basis.
    """

    amplitudes: Array
    drive: Array
    softness: float
    lagged: Array | None = None
    turns: Array | None = None
    turning: Turning | None = None

    def of(self, modes: int) -> Seen:
        """The same with the first ``modes`` of the modes."""
        lagged = None if self.lagged is None else self.lagged[..., :modes]
        return replace(self, amplitudes=self.amplitudes[:, :modes], lagged=lagged)

    def past(self, history: int) -> Array:
        """[a^t … a^{t-h}] for t = h … T-2, (T-1-h, (h+1) R)."""
        if self.lagged is not None:
            flat: Array = self.lagged.reshape(len(self.lagged), -1)
            return flat
        t = np.arange(history, len(self.amplitudes) - 1)
        return np.concatenate([self.amplitudes[t - lag] for lag in range(history + 1)], axis=1)


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
        past = s.past(history)
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

    Args:
        grams: normal equations of all episodes.
        scale: of their inputs, one each.
        choice: number of modes and the ridges.
        modes: how many the normal equations have.
        history: h.
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

    Those beyond the R fitted are predicted as 0.  Infinite where a
    prediction left the numbers.

    Args:
        weight: of lagged amplitudes and drives (R, F).
        response: their change by powers of ζ (2, R, L + 1).
        judged: episodes, of which at most R amplitudes are predicted.
        softness: the ζ at which each is predicted (E,).
        history: h.
    """
    count, lags = len(weight), (history + 1) * len(weight)
    zeta = softness[:, None]
    frames = max(len(s.amplitudes) for s in judged)
    path = np.zeros((frames, len(judged), count))
    driven = np.zeros((frames, len(judged), count))
    turns = np.tile(np.eye(3), (frames, len(judged), 1, 1))
    for k, s in enumerate(judged):
        path[: history + 1, k] = s.amplitudes[: history + 1, :count]
        if s.turns is not None and s.lagged is not None:
            path[: history + 1, k] = s.lagged[0, ::-1, :count]
            turns[history + 1 : len(s.amplitudes), k] = s.turns
        driven[history + 1 : len(s.amplitudes), k] = s.drive @ weight[:, lags:].T
    predicted = path if judged[0].turning is None else np.zeros_like(path)
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
            if (turning := judged[0].turning) is not None:
                predicted[t + 1] = path[t + 1]
                lately = path[t + 1 - history : t + 2].transpose(1, 0, 2)
                path[t + 1 - history : t + 2] = turning.turned(lately, turns[t + 1]).transpose(1, 0, 2)
        found = np.empty(len(judged))
        for k, s in enumerate(judged):
            gap = predicted[: len(s.amplitudes), k] - s.amplitudes[:, :count]
            square = (gap**2).sum(axis=1) + (s.amplitudes[:, count:] ** 2).sum(axis=1)
            if s.turning is not None:
                square = square[history + 1 :]
            found[k] = np.sqrt(square.mean())
    return np.where(np.isfinite(found), found, np.inf)
