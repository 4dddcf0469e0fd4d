"""The modal prior: the best linear model of the data, in closed form, on which the network's correction sits.

The object's places relative to its grips, g = x - c̄ - mean (c̄: mean of the control vertices), are written
in their R principal modes, a = basis · g; the next amplitudes are a linear function of the last h + 1 and
of what the grips do (dynamic mode decomposition with control, Proctor et al. 2016), found by ridge
regression:

    a^{t+1} = weight · [a^t … a^{t-h}, d^{t+1} … d^{t-h}, e^{t+1}, e^{t-1} … e^{t-h}, 1]
            + ζ response_1 · [a^t … a^{t-h}, 1] + ζ² response_2 · [a^t … a^{t-h}, 1]
    ζ = Σ_i placing_i · (log(E_i/E_fit), log(ρ_i/ρ_fit)), no further out than span
    d^s = x_c^s - c̄^s - shape   (C, 3), the grips' own shape;   e^s = c̄^s - c̄^t   (3,), their path
    x̂^{t+1} = c̄^{t+1} + mean + a^{t+1} · basis

Why: at 30 steps a second an elastic body's motion is global (a bending wave crosses it within a step), and
most of it is linear. Least squares finds that part in a second; a message-passing network needs thousands
of steps. ``response`` is how the modes' frequencies answer to the ratio of stiffness to density, all that shows of a
homogeneous change under gravity and driven grips; two powers of ζ, since a phase that is a few percent wrong is all
wrong after ten swings. Where the ratio counts, at the root of a beam for stiffness and at its end for
density, is what ``placing`` says (:mod:`physworld.worldmodel.priors.modal_places`). What is left to the network is what
such a map lacks: large rotations, stretching, contact. The prior is equivariant to translations. The number of modes
and the ridges, and whether there is a response at all, are those with the least open-loop error in a cross-validation
over episodes. No free motion grows, whatever Φ (:mod:`physworld.worldmodel.priors.modal_poles`).

Legend: T frames, n object vertices, C control vertices, R modes, F regressors, L = (h+1) R, h history. NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.worldmodel.errors import DatasetUnusable
from physworld.worldmodel.model.frame import GripFrame, turns_of
from physworld.worldmodel.priors.modal_places import find_places, mean_placing
from physworld.worldmodel.priors.modal_poles import without_growth
from physworld.worldmodel.priors.modal_regression import (
    POWERS,
    SCALE_FLOOR,
    Choice,
    Grams,
    Seen,
    Turning,
    errors,
    grams_of,
    regress,
    scale_of,
)

RIDGES = (1e-5, 1e-4, 1e-3)
RESPONSE_RIDGES = (1e-5, 1e-4, 1e-3)
MODE_COUNTS = (6, 12, 24, 48)
FOLDS = 5  # of the cross-validation that chooses among these
LAGGING = 1.3  # times the best's error: what errs more after some folds is not tried on the others


@dataclass(frozen=True)
class ModalPrior:
    """``mean`` (n, 3) [m], ``basis`` (R, n, 3) orthonormal, ``shape`` (C, 3) [m], ``weight`` (R, F), ``response``
    (2, R, L + 1), ``placing`` (n, 2), ``span`` (2,): least and largest ζ of the episodes.
    """

    mean: Array
    basis: Array
    shape: Array
    weight: Array
    response: Array
    placing: Array
    span: Array

    def __post_init__(self) -> None:
        """The rollout engine reads these arrays by their sizes. Raises ValueError for others."""
        modes, n = self.basis.shape[:2]
        controls, rows = len(self.shape), max(modes, 1)
        lags = max(([0, *self.response.shape][-1] - 1) // rows, 1)
        expected = {
            "mean": (n, 3),
            "basis": (modes, n, 3),
            "shape": (controls, 3),
            "weight": (modes, regressor_count(modes, controls, lags - 1)),
            "response": (POWERS, modes, lags * modes + 1),
            "placing": (n, 2),
            "span": (2,),
        }
        found = {name: getattr(self, name).shape for name in expected}
        if wrong := [f"{name} {found[name]}" for name, shape in expected.items() if found[name] != shape]:
            raise ValueError(f"{modes} modes of {n} vertices, but the prior has {', '.join(wrong)}")


def regressor_count(modes: int, controls: int, history: int) -> int:
    """F."""
    return (history + 1) * modes + (history + 2) * 3 * controls + (history + 1) * 3 + 1


def rigid_prior(vertices: Array, controls: Array, history: int) -> ModalPrior:
    """The prior without data: object vertices (n, 3) follow the control vertices (C, 3) as they lie."""
    anchor = controls.mean(axis=0)
    return ModalPrior(
        mean=vertices - anchor,
        basis=np.zeros((1, len(vertices), 3)),
        shape=controls - anchor,
        weight=np.zeros((1, regressor_count(1, len(controls), history))),
        response=np.zeros((POWERS, 1, history + 2)),
        placing=mean_placing(len(vertices)),
        span=np.zeros(2),
    )


def fit_prior(
    episodes: list[Array],
    phis: list[Array],
    n: int,
    history: int,
    most_modes: int,
    frame: GripFrame | None = None,
) -> ModalPrior:
    """The modal prior of vertex tracks.

    With a ``frame`` it is that of a step in the grip's frame (``physworld.worldmodel.model.frame``).

    Args:
        episodes: vertex tracks (T, V, 3) [m], object vertices first.
        phis: log property ratios of each (n, 2 or more).
        n: object vertices.
        history: h.
        most_modes: at most; few vertices have fewer.
        frame: None for world axes.

    Raises:
        DatasetUnusable: the graph has no control vertex.
    """
    if episodes[0].shape[1] == n:
        raise DatasetUnusable("the graph has no control vertex: there is nothing to move the object by")
    paths = [np.asarray(episode, dtype=np.float64) for episode in episodes]
    rotations = [None if frame is None else turns_of(frame, path[:, n:]) for path in paths]
    shape = np.mean(
        [_control_shape(path, n, turns)[0] for path, turns in zip(paths, rotations, strict=True)], axis=0
    )
    relative = [_relative(path, n, turns) for path, turns in zip(paths, rotations, strict=True)]
    framed = [(path, turns) for path, turns in zip(paths, rotations, strict=True) if turns is not None]
    lagged = [_lagged(path, n, history, turns) for path, turns in framed]
    mean = np.concatenate(relative).reshape(-1, 3 * n).mean(axis=0)
    flat = np.concatenate([*relative, *(past[:, -1] for past in lagged)]).reshape(-1, 3 * n)
    variance, modes = np.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
    size = np.sqrt(np.clip(variance[::-1], 0.0, None))
    basis = np.ascontiguousarray(modes[:, ::-1].T[: min(most_modes, len(size))])
    size = np.maximum(size[: len(basis)], max(SCALE_FLOOR * size[0], np.finfo(float).tiny))
    fall = None if frame is None else frame.fall
    seen = [
        Seen((gone.reshape(-1, 3 * n) - mean) @ basis.T, _drive(path, n, shape, history, turns, fall), 0.0)
        for gone, path, turns in zip(relative, paths, rotations, strict=True)
    ]
    if frame is not None:
        turning = _turning(basis.reshape(-1, n, 3), mean.reshape(n, 3))
        seen = [
            replace(
                s,
                lagged=(past.reshape(*past.shape[:2], 3 * n) - mean) @ basis.T,
                turns=_between(turns, history),
                turning=turning,
            )
            for s, past, turns in zip(seen, lagged, rotations, strict=True)
            if turns is not None
        ]
    fields = np.stack([np.asarray(phi, dtype=np.float64)[:, :2] for phi in phis])
    placing = find_places(seen, fields, size, history)
    zeta = np.tensordot(fields, placing, axes=2)
    seen = [replace(s, softness=float(value)) for s, value in zip(seen, zeta, strict=True)]
    span = (min(0.0, float(zeta.min())), max(0.0, float(zeta.max())))
    scale = scale_of(seen, size, history)
    grams = grams_of(seen, scale, history)
    choice = _choose(seen, size, grams, span, history)
    fitted = regress(grams, scale, choice, len(basis), history)
    weight, response = without_growth(*fitted, size[: choice.modes], span, history)
    kept = basis[: choice.modes].reshape(choice.modes, n, 3)
    return ModalPrior(mean.reshape(n, 3), kept, shape, weight, response, placing, np.array(span))


def _control_shape(path: Array, n: int, turns: Array | None = None) -> Array:
    """Control vertices around their mean, (T, C, 3), seen from ``turns`` (T, 3, 3)."""
    shape: Array = path[:, n:] - path[:, n:].mean(axis=1, keepdims=True)
    return shape if turns is None else shape @ turns


def _relative(path: Array, n: int, turns: Array | None) -> Array:
    """Object vertices against the grips, (T, n, 3), each frame seen from its own turn."""
    gone: Array = path[:, :n] - path[:, n:].mean(axis=1, keepdims=True)
    return gone if turns is None else gone @ turns


def _lagged(path: Array, n: int, history: int, turns: Array) -> Array:
    """Object vertices at t … t-h against the grips of their time, seen from the turn at t+1: (T-1-h, h+1, n, 3)."""
    t, gone = np.arange(history, len(path) - 1), _relative(path, n, None)
    past: Array = np.stack([gone[t - lag] @ turns[t + 1] for lag in range(history + 1)], axis=1)
    return past


def _between(turns: Array, history: int) -> Array:
    """Q from the frame of each step t = h … T-2 to the next one's, (T-1-h, 3, 3); none after the last."""
    after = np.minimum(np.arange(history + 2, len(turns) + 1), len(turns) - 1)
    between: Array = turns[after].transpose(0, 2, 1) @ turns[history + 1 :]
    return between


def _turning(basis: Array, mean: Array) -> Turning:
    """What turns modes of ``basis`` (R, n, 3) about ``mean`` (n, 3)."""
    products = np.einsum("rik,sil->klrs", basis, basis, optimize=True)
    means = np.einsum("rik,il->klr", basis, mean)
    return Turning(products, means, np.einsum("rik,ik->r", basis, mean))


def _drive(
    path: Array, n: int, shape: Array, history: int, turns: Array | None = None, fall: Array | None = None
) -> Array:
    """The regressors that the grips give for each step t → t+1, t = h … T-2, (T-1-h, ·)."""
    own, centre = _control_shape(path, n), path[:, n:].mean(axis=1)
    t = np.arange(history, len(path) - 1)
    lags = [1, *range(0, -history - 1, -1)]
    shapes = [own[t + lag] for lag in lags]
    moves = [centre[t + lag] - centre[t] for lag in lags if lag != 0]
    if turns is not None and fall is not None:
        shapes = [one @ turns[t + 1] for one in shapes]
        falling = [lag**2 * fall for lag in lags if lag != 0]
        moves = [
            ((one - fallen)[:, None] @ turns[t + 1])[:, 0] for one, fallen in zip(moves, falling, strict=True)
        ]
    turned = [(one - shape).reshape(len(t), -1) for one in shapes]
    return np.concatenate([*turned, *moves, np.ones((len(t), 1))], axis=1)


def _choose(seen: list[Seen], size: Array, grams: Grams, span: tuple[float, float], history: int) -> Choice:
    """The choice with the least open-loop error on episodes left out, each once (cross-validation).

    More modes are tried as long as they err less.
    """
    modes, scale = len(size), scale_of(seen, size, history)
    folds = [seen[k::FOLDS] for k in range(min(FOLDS, len(seen)))]
    if len(folds) > 1:
        splits = [(grams.without(grams_of(fold, scale, history)), fold) for fold in folds]
    else:
        splits = [(grams, seen)]

    def error(choice: Choice, kept: Grams, judged: list[Seen]) -> float:
        fitted = regress(kept, scale, choice, modes, history)
        fitted = without_growth(*fitted, size[: choice.modes], span, history)
        return float(errors(*fitted, judged, np.array([s.softness for s in judged]), history).sum())

    best, least = Choice(min(MODE_COUNTS[0], modes), RIDGES[0], np.inf), np.inf
    for count in sorted({min(some, modes) for some in MODE_COUNTS}):
        totals = {Choice(count, a, b): 0.0 for a in RIDGES for b in (np.inf, *RESPONSE_RIDGES)}
        for kept, judged in splits:
            totals = {choice: total + error(choice, kept, judged) for choice, total in totals.items()}
            bar = LAGGING * min(totals.values())
            totals = {choice: total for choice, total in totals.items() if total <= bar}
        chosen = min(totals, key=totals.__getitem__)
        if totals[chosen] >= least:
            break
        best, least = chosen, totals[chosen]
    return best
