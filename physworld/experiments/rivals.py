"""Rivals: models that explain a recording alike, and what a refit of one could hide of its difference from another.

A recording that says little of a body's stiffness leaves rivals at different ends of the same flat basin. That is a
difference of calibration and not of what they claim, so before a search every rival is brought to the first one's
calibrated numbers, as far as its own fit to the recording allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.effects.registry import EFFECTS
from physworld.estimation.refit import Refit, prior_rows
from physworld.estimation.unknowns import Unknown, at, bounds_of
from physworld.twin.twin import Twin

_RIDGE = 1e-9
_AFFORDABLE, _AFFORDABLE_SHARE = (
    9.0,
    0.01,
)  # rise of a squared misfit up to which a rival may be moved: so much, or
# this share of it, whichever is more


@dataclass(frozen=True)
class Rival:
    """A model to be told from others.

    Attributes:
        names: its effects.
        twin: with every unknown at its start.
        unknowns: what a refit would change.
        information: what the recording at hand says of them, (p, p); None: nothing.
        residual: whitened, of the recording at hand, (M,), or None.
        offset: starts of the unknowns minus their optimum in the recording, (p,); None: zero.
    """

    names: tuple[str, ...]
    twin: Twin
    unknowns: tuple[Unknown, ...] = ()
    information: Array | None = None
    residual: Array | None = None
    offset: Array | None = None

    @property
    def label(self) -> str:
        """For people."""
        return " with ".join(EFFECTS[name].title for name in self.names) or "the declared physics"

    @property
    def start(self) -> Array:
        """Starts of the unknowns, (p,)."""
        return np.array([unknown.start for unknown in self.unknowns])

    def moved(self, change: Array) -> Rival:
        """With its unknowns started elsewhere, (p,), within their bounds."""
        low, high = bounds_of(self.unknowns)
        there = np.clip(self.start + change, low, high)
        before = np.zeros(len(there)) if self.offset is None else self.offset
        return replace(
            self,
            twin=at(self.twin, list(self.unknowns), there),
            unknowns=tuple(u.starting(t) for u, t in zip(self.unknowns, there, strict=True)),
            offset=before + there - self.start,
        )


def rival_of(names: tuple[str, ...], fitted: Refit) -> Rival:
    """A fitted set of effects of these names as a rival."""
    _, slope = prior_rows(fitted.unknowns, fitted.theta)
    information = fitted.jacobian.T @ fitted.jacobian + slope.T @ slope
    return Rival(names, fitted.twin, tuple(fitted.unknowns), information, fitted.residual)


def reconciled(rivals: list[Rival], cost: Callable[[Twin], float] | None) -> list[Rival]:
    """The rivals at the first one's numbers where they share them, if the recording lets them go there.

    Args:
        cost: squared whitened misfit of a twin in the recording; None: the rivals stay where they are.
    """
    if cost is None:
        return rivals
    return [rivals[0], *(_towards(rival, rivals[0], cost) for rival in rivals[1:])]


def _towards(rival: Rival, first: Rival, cost: Callable[[Twin], float]) -> Rival:
    """The basin may be curved, so the recording itself is asked: with the rival's own numbers kept, and followed."""
    known = {unknown.name: unknown.start for unknown in first.unknowns}
    shared = np.array([unknown.name in known for unknown in rival.unknowns], dtype=bool)
    if not shared.any():
        return rival
    plain = np.array([known.get(u.name, u.start) - u.start for u in rival.unknowns])
    ways = [plain]
    if rival.information is not None and not shared.all():
        own, information = ~shared, rival.information
        inner = information[np.ix_(own, own)]
        pull = information[np.ix_(own, shared)] @ plain[shared]
        followed = plain.copy()
        followed[own] = -np.linalg.solve(inner + _RIDGE * np.diag(np.diag(inner) + 1e-30), pull)
        ways.append(followed)
    here = cost(rival.twin)
    ends = [rival.moved(way) for way in ways]
    costs = [cost(end.twin) for end in ends]
    best = int(np.argmin(costs))
    affordable = here + max(_AFFORDABLE, _AFFORDABLE_SHARE * here)
    return replace(ends[best], offset=None) if costs[best] <= affordable else rival


def refit_of(
    difference: Array,
    slope: Array,
    information: Array | None,
    offset: Array | None = None,
) -> tuple[Array, float]:
    """The change x (p,) of the unknowns that hides most of a difference, and the norm of what it cannot hide.

    Minimises |difference - slope x|^2 + (x + offset)^T information (x + offset).

    Args:
        difference: over the noise, (M,).
        slope: of the prediction, over the noise, (M, p).
        information: what else is known of the unknowns, (p, p); None: nothing.
        offset: where they are from where that knowledge puts them, (p,); None: there.
    """
    count = slope.shape[1]
    if not count:
        return np.zeros(0), float(np.linalg.norm(difference))
    known = np.zeros((count, count)) if information is None else information
    away = np.zeros(count) if offset is None else offset
    normal = slope.T @ slope + known
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    ridged = normal / np.outer(scale, scale) + _RIDGE * np.eye(count)
    change = np.linalg.solve(ridged, (slope.T @ difference - known @ away) / scale) / scale
    left, there = difference - slope @ change, change + away
    return change, float(np.sqrt(max(float(left @ left + there @ known @ there), 0.0)))
