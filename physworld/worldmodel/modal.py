"""The modal prior: the best linear model of the data, in closed form, on which the network's correction sits.

The object's places relative to its grips, g = x - c̄ - mean (c̄: mean of the control vertices), are written
in their R principal modes, a = basis · g; the next amplitudes are a linear function of the last h + 1 and
of what the grips do (dynamic mode decomposition with control, Proctor et al. 2016), found by ridge
regression:

    a^{t+1} = weight · [a^t … a^{t-h}, d^{t+1} … d^{t-h}, e^{t+1}, e^{t-1} … e^{t-h}, 1]
            + ζ response · [a^t … a^{t-h}, 1]
    ζ = mean_i (log(E_i/E_fit) - log(ρ_i/ρ_fit))
    d^s = x_c^s - c̄^s - shape   (C, 3), the grips' own shape;   e^s = c̄^s - c̄^t   (3,), their path
    x̂^{t+1} = c̄^{t+1} + mean + a^{t+1} · basis

Why: at 30 steps a second an elastic body's motion is global (a bending wave crosses it within a step), and
most of it is linear. Least squares finds that part in a second; a message-passing network needs thousands
of steps. ``response`` is how the modes' frequencies answer to the ratio of stiffness to density, all that shows of a
homogeneous change under gravity and driven grips. What is left to the network is what such a map lacks: Φ place by
place, large rotations, stretching, contact. The prior is equivariant to translations. The number of modes and the
ridges, and whether there is a response at all, are those with the least open-loop error in a cross-validation over
episodes.

A passive body's motion does not grow of itself, a least-squares map of a few noisy modes may: for some mode an
eigenvalue lies outside the unit circle, and a session that runs longer than an episode blows up. With A_k the weight
of a^{t-k}, k = 0 … h, the maps γ^{k+1} A_k have γ times the eigenvalues of the A_k; so every map is shrunk by the
largest γ ≤ 1 that leaves none outside at any ζ of the episodes, before it is judged.

Legend: T frames, n object vertices, C control vertices, R modes, F regressors, h history. NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.worldmodel.errors import DatasetUnusable

RIDGES = (1e-5, 1e-4, 1e-3)
RESPONSE_RIDGES = (1e-4, 1e-2)
MODE_COUNTS = (6, 12, 24, 48)
FOLDS = 5  # of the cross-validation that chooses among these
SOFTNESSES = 5  # values of ζ over the episodes' range at which no motion may grow
SCALE_FLOOR = 1e-3  # of the largest: a regressor that hardly moves must not get a large weight


@dataclass(frozen=True)
class ModalPrior:
    """``mean`` (n, 3) [m], ``basis`` (R, n, 3) orthonormal, ``shape`` (C, 3) [m], ``weight`` (R, F), ``response``
    (R, (h+1) R + 1).
    """

    mean: np.ndarray
    basis: np.ndarray
    shape: np.ndarray
    weight: np.ndarray
    response: np.ndarray


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
        response=np.zeros((1, history + 2)),
    )


def softness(phi: np.ndarray) -> float:
    """ζ of log property ratios (n, 2)."""
    return float(np.mean(phi[:, 0] - phi[:, 1]))


def fit_prior(
    episodes: list[np.ndarray], phis: list[np.ndarray], n: int, history: int, most_modes: int
) -> ModalPrior:
    """The prior of vertex tracks (T, V, 3), object vertices first, and their log property ratios (n, 2)."""
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
    seen = [
        _Seen((gone.reshape(-1, 3 * n) - mean) @ basis.T, _drive(path, n, shape, history), softness(phi))
        for gone, path, phi in zip(relative, paths, phis, strict=True)
    ]
    scale = _scale(seen, size[: len(basis)], history)
    grams = _grams(seen, scale, history)
    choice = _choose(seen, scale, grams, history)
    weight, response = _bounded(*_regress(grams, scale, choice, len(basis), history), seen, history)
    kept = basis[: choice.modes].reshape(choice.modes, n, 3)
    return ModalPrior(mean.reshape(n, 3), kept, shape, weight, response)


@dataclass(frozen=True)
class _Seen:
    """An episode: amplitudes (T, R), what the grips do (T-1-h, ·), ζ."""

    amplitudes: np.ndarray
    drive: np.ndarray
    softness: float


@dataclass(frozen=True)
class _Choice:
    """How many modes, and ridges per row; an infinite ``response_ridge`` leaves the response out."""

    modes: int
    ridge: float
    response_ridge: float


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


@dataclass(frozen=True)
class _Grams:
    """Normal equations of the regression, summed over episodes, for all modes: regressors are
    [past (h+1) R, drive D, ζ past (h+1) R, ζ].

    ``inputs`` (G, G), ``targets`` (G, R), ``rows``: how many steps they count.
    """

    inputs: np.ndarray
    targets: np.ndarray
    rows: int

    def without(self, other: _Grams) -> _Grams:
        """What is left when ``other``'s episodes are taken away."""
        return _Grams(self.inputs - other.inputs, self.targets - other.targets, self.rows - other.rows)


def _grams(seen: list[_Seen], scale: np.ndarray, history: int) -> _Grams:
    past = np.concatenate([_past(s.amplitudes, history) for s in seen])
    drive = np.concatenate([s.drive for s in seen])
    zeta = np.concatenate([np.full((len(s.drive), 1), s.softness) for s in seen])
    inputs = np.concatenate([past, drive, zeta * past, zeta], axis=1) / scale
    target = np.concatenate([s.amplitudes[history + 1 :] for s in seen])
    return _Grams(inputs.T @ inputs, inputs.T @ target, len(inputs))


def _scale(seen: list[_Seen], size: np.ndarray, history: int) -> np.ndarray:
    """Sizes of the regressors: their spread, not below a share of the largest."""
    spread = np.concatenate([s.drive for s in seen]).std(axis=0)
    lagged = np.maximum(np.tile(size, history + 1), SCALE_FLOOR * size[0])
    drive = np.maximum(spread, max(SCALE_FLOOR * spread.max(), lagged.min()))
    drive[-1] = 1.0
    return np.concatenate([lagged, drive, lagged, [1.0]])


def _regress(
    grams: _Grams, scale: np.ndarray, choice: _Choice, modes: int, history: int
) -> tuple[np.ndarray, np.ndarray]:
    """Ridge regression of the next amplitudes: weight (R, F) and response (R, (h+1) R + 1)."""
    lags = np.concatenate([np.arange(choice.modes) + k * modes for k in range(history + 1)])
    drive = np.arange((history + 1) * modes, len(scale) - (history + 1) * modes - 1)
    answer = np.append(lags + drive[-1] + 1, len(scale) - 1)
    respond = np.isfinite(choice.response_ridge)
    taken = np.concatenate([lags, drive, answer if respond else []]).astype(int)
    own = len(lags) + len(drive)
    penalties = np.full(len(taken), choice.ridge)
    penalties[own:] = choice.response_ridge
    system = grams.inputs[np.ix_(taken, taken)] + grams.rows * np.diag(penalties)
    solution = np.linalg.solve(system, grams.targets[taken, : choice.modes]).T / scale[taken]
    response = solution[:, own:] if respond else np.zeros((choice.modes, len(answer)))
    return solution[:, :own], response


def growth(weight: np.ndarray, response: np.ndarray, zeta: float, history: int) -> float:
    """Largest factor by which a free motion of the modes grows in a step: the spectral radius at ζ."""
    count = len(weight)
    lags = (history + 1) * count
    companion = np.eye(lags, k=-count)
    companion[:count] = weight[:, :lags] + zeta * response[:, :lags]
    return float(np.abs(np.linalg.eigvals(companion)).max())


def _bounded(
    weight: np.ndarray, response: np.ndarray, seen: list[_Seen], history: int
) -> tuple[np.ndarray, np.ndarray]:
    """The map shrunk until no free motion grows, see the module's text."""
    zetas = [0.0, *(s.softness for s in seen)]
    span = np.linspace(min(zetas), max(zetas), SOFTNESSES) if response.any() else [0.0]
    most = max(growth(weight, response, float(zeta), history) for zeta in span)
    if most <= 1.0:
        return weight, response
    lags = (history + 1) * len(weight)
    shrink = np.repeat(most ** -np.arange(1.0, history + 2), len(weight))
    weight, response = weight.copy(), response.copy()
    weight[:, :lags] *= shrink
    response[:, :lags] *= shrink
    return weight, response


def _choose(seen: list[_Seen], scale: np.ndarray, grams: _Grams, history: int) -> _Choice:
    """The choice with the least open-loop error on episodes left out, each once (cross-validation)."""
    modes = seen[0].amplitudes.shape[1]
    folds = [seen[k::FOLDS] for k in range(min(FOLDS, len(seen)))]
    if len(folds) > 1:
        splits = [(grams.without(_grams(fold, scale, history)), fold) for fold in folds]
    else:
        splits = [(grams, seen)]
    choices = [
        _Choice(count, ridge, response)
        for count in sorted({min(some, modes) for some in MODE_COUNTS})
        for ridge in RIDGES
        for response in (np.inf, *RESPONSE_RIDGES)
    ]

    def error(choice: _Choice) -> float:
        return sum(
            _open_loop_error(
                *_bounded(*_regress(kept, scale, choice, modes, history), seen, history), judged, history
            )
            for kept, judged in splits
        )

    return min(choices, key=error)


def _open_loop_error(weight: np.ndarray, response: np.ndarray, judged: list[_Seen], history: int) -> float:
    """Sum over episodes of the root mean square error of all amplitudes, those beyond the fitted ones taken as 0."""
    count, lags = len(weight), (history + 1) * len(weight)
    zeta = np.array([s.softness for s in judged])[:, None]
    frames = max(len(s.amplitudes) for s in judged)
    path = np.zeros((frames, len(judged), count))
    driven = np.zeros((frames, len(judged), count))
    for k, s in enumerate(judged):
        path[: history + 1, k] = s.amplitudes[: history + 1, :count]
        driven[history + 1 : len(s.amplitudes), k] = s.drive @ weight[:, lags:].T
    driven += zeta * response[:, -1]
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(history, frames - 1):
            past = np.concatenate([path[t - lag] for lag in range(history + 1)], axis=1)
            path[t + 1] = past @ weight[:, :lags].T + zeta * (past @ response[:, :-1].T) + driven[t + 1]
        total = 0.0
        for k, s in enumerate(judged):
            gap = path[: len(s.amplitudes), k] - s.amplitudes[:, :count]
            square = (gap**2).sum(axis=1) + (s.amplitudes[:, count:] ** 2).sum(axis=1)
            total += float(np.sqrt(square.mean()))
    return total if np.isfinite(total) else np.inf
