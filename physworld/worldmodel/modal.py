"""The modal prior: the best linear model of the data, in closed form, on which the network's correction sits.

The object's places relative to its grips, g = x - c̄ - mean (c̄: mean of the control vertices), are written
in their R principal modes, a = basis · g; the next amplitudes are a linear function of the last h + 1 and
of what the grips do (dynamic mode decomposition with control, Proctor et al. 2016), found by ridge
regression:

    a^{t+1} = weight · [a^t … a^{t-h}, d^{t+1} … d^{t-h}, e^{t+1}, e^{t-1} … e^{t-h}, 1]
    d^s = x_c^s - c̄^s - shape   (C, 3), the grips' own shape;   e^s = c̄^s - c̄^t   (3,), their path
    x̂^{t+1} = c̄^{t+1} + mean + a^{t+1} · basis

Why: at 30 steps a second an elastic body's motion is global (a bending wave crosses it within a step), and
most of it is linear. Least squares finds that part in a second; a message-passing network needs thousands
of steps. What is left to the network is what a linear map lacks: Φ, large rotations, stretching, contact.
The prior is equivariant to translations. Number of modes and ridge are those with the least open-loop error
on episodes kept aside.

Legend: T frames, n object vertices, C control vertices, R modes, F regressors, h history. NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.worldmodel.errors import DatasetUnusable

RIDGES = (1e-5, 1e-4, 1e-3, 1e-2)
MODE_COUNTS = (6, 12, 24, 48)
KEPT_ASIDE = 0.2  # of the episodes, to choose among these
SCALE_FLOOR = 1e-3  # of the largest: a regressor that hardly moves must not get a large weight


@dataclass(frozen=True)
class ModalPrior:
    """``mean`` (n, 3) [m], ``basis`` (R, n, 3) orthonormal, ``shape`` (C, 3) [m], ``weight`` (R, F)."""

    mean: np.ndarray
    basis: np.ndarray
    shape: np.ndarray
    weight: np.ndarray


def regressor_count(modes: int, controls: int, history: int) -> int:
    """F."""
    return (history + 1) * modes + (history + 2) * 3 * controls + (history + 1) * 3 + 1


def rigid_prior(vertices: np.ndarray, controls: np.ndarray, history: int) -> ModalPrior:
    """The prior without data: object vertices (n, 3) follow the control vertices (C, 3) as they lie."""
    anchor = controls.mean(axis=0)
    return ModalPrior(
        mean=vertices - anchor,
        basis=np.zeros((1, len(vertices), 3)),
        shape=controls - anchor,
        weight=np.zeros((1, regressor_count(1, len(controls), history))),
    )


def fit_prior(episodes: list[np.ndarray], n: int, history: int, most_modes: int) -> ModalPrior:
    """The prior of vertex tracks (T, V, 3), object vertices first."""
    if episodes[0].shape[1] == n:
        raise DatasetUnusable("the graph has no control vertex: there is nothing to move the object by")
    paths = [np.asarray(episode, dtype=np.float64) for episode in episodes]
    shape = np.mean([_control_shape(path, n)[0] for path in paths], axis=0)
    relative = [path[:, :n] - path[:, n:].mean(axis=1, keepdims=True) for path in paths]
    flat = np.concatenate(relative).reshape(-1, 3 * n)
    mean = flat.mean(axis=0)
    variance, modes = np.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
    size = np.sqrt(np.clip(variance[::-1], 0.0, None))
    basis = np.ascontiguousarray(modes[:, ::-1].T[: min(most_modes, len(size))])
    amplitudes = [(path.reshape(-1, 3 * n) - mean) @ basis.T for path in relative]
    drives = [_drive(path, n, shape, history) for path in paths]
    count, ridge = _choose(amplitudes, drives, size, history)
    weight = _regress([a[:, :count] for a in amplitudes], drives, size[:count], history, ridge)
    return ModalPrior(mean.reshape(n, 3), basis[:count].reshape(count, n, 3), shape, weight)


def _control_shape(path: np.ndarray, n: int) -> np.ndarray:
    """Control vertices around their mean, (T, C, 3)."""
    return path[:, n:] - path[:, n:].mean(axis=1, keepdims=True)


def _drive(path: np.ndarray, n: int, shape: np.ndarray, history: int) -> np.ndarray:
    """The regressors that the grips give for each step t → t+1, t = h … T-2, (T-1-h, ·)."""
    own, centre = _control_shape(path, n) - shape, path[:, n:].mean(axis=1)
    t = np.arange(history, len(path) - 1)
    lags = [1, *range(0, -history - 1, -1)]
    turns = [own[t + lag].reshape(len(t), -1) for lag in lags]
    moves = [centre[t + lag] - centre[t] for lag in lags if lag != 0]
    return np.concatenate([*turns, *moves, np.ones((len(t), 1))], axis=1)


def _past(amplitudes: np.ndarray, history: int) -> np.ndarray:
    """[a^t … a^{t-h}] for t = h … T-2."""
    t = np.arange(history, len(amplitudes) - 1)
    return np.concatenate([amplitudes[t - lag] for lag in range(history + 1)], axis=1)


def _regress(
    amplitudes: list[np.ndarray], drives: list[np.ndarray], size: np.ndarray, history: int, ridge: float
) -> np.ndarray:
    """Ridge regression of the next amplitudes, regressors scaled to comparable size, (R, F)."""
    past = np.concatenate([_past(a, history) for a in amplitudes])
    drive = np.concatenate(drives)
    spread = drive.std(axis=0)
    scale = np.concatenate([np.tile(size, history + 1), np.maximum(spread, SCALE_FLOOR * spread.max())])
    scale = np.maximum(scale, SCALE_FLOOR * size[0])
    scale[-1] = 1.0
    inputs = np.concatenate([past, drive], axis=1) / scale
    target = np.concatenate([a[history + 1 :] for a in amplitudes])
    system = inputs.T @ inputs + ridge * len(inputs) * np.eye(len(scale))
    return np.linalg.solve(system, inputs.T @ target).T / scale


def _choose(
    amplitudes: list[np.ndarray], drives: list[np.ndarray], size: np.ndarray, history: int
) -> tuple[int, float]:
    """Number of modes and ridge with the least open-loop error on episodes kept aside."""
    aside = max(1, round(KEPT_ASIDE * len(amplitudes))) if len(amplitudes) > 1 else 0
    fitting = slice(0, len(amplitudes) - aside)
    judging = slice(len(amplitudes) - aside, None) if aside else slice(None)
    best = (np.inf, 1, RIDGES[-1])
    for count in sorted({min(modes, amplitudes[0].shape[1]) for modes in MODE_COUNTS}):
        for ridge in RIDGES:
            kept = [a[:, :count] for a in amplitudes[fitting]]
            weight = _regress(kept, drives[fitting], size[:count], history, ridge)
            judged = zip(amplitudes[judging], drives[judging], strict=True)
            error = float(
                np.mean([_open_loop_error(weight, a, drive, count, history) for a, drive in judged])
            )
            if error < best[0]:
                best = (error, count, ridge)
    return best[1], best[2]


def _open_loop_error(
    weight: np.ndarray, amplitudes: np.ndarray, drive: np.ndarray, count: int, history: int
) -> float:
    """Mean square error of all amplitudes, those beyond ``count`` taken as 0, over a rollout."""
    path = np.zeros_like(amplitudes)
    path[: history + 1, :count] = amplitudes[: history + 1, :count]
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(history, len(path) - 1):
            past = path[t - history : t + 1, :count][::-1].reshape(-1)
            path[t + 1, :count] = weight @ np.concatenate([past, drive[t - history]])
        error = float(((path - amplitudes) ** 2).sum(axis=1).mean())
    return error if np.isfinite(error) else np.inf
