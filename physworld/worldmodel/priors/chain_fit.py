"""Fitting a chain prior to episodes: speed of stretch waves, bending, friction, drag and gravity.

Least squares on what the chain predicts, open loop: one tick at first, from two stiffnesses, then longer and longer
windows up to whole episodes. How many segments the chain has is chosen on episodes that the fit did not see.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import least_squares

from physworld.arrays import Array
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.native.chain_native import ChainRoller
from physworld.worldmodel.priors.chain import ChainPhysics, ChainPrior, chain_of
from physworld.worldmodel.priors.chain_layout import ChainLayout, arc_lengths, held_vertices, lay_out

SEGMENTS = (12, 16, 20)
FITTED = 10  # episodes of the fit, and as many to choose by
WINDOWS = (1, 10, 30)  # ticks, before whole episodes
EVERY_VERTEX = 3
STARTS = (1e-3, 3e-2)  # bending stiffnesses [m^4/s^2] of a rope of 1 m
G = 9.81
LOW = np.array([np.log(3.0), np.log(1e-6), np.log(1e-4), np.log(1e-3), -3.0, -3.0, -3.0])
HIGH = np.array([np.log(90.0), np.log(3.0), np.log(0.3), np.log(5.0), 3.0, 3.0, 3.0])
SIZES = np.array([1.0, 1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
SOFT = 0.02  # share of the length beyond which a miss counts linearly
TOLERANCE = 1e-3  # relative; a figure of the physics is not asked for more
MARGIN = 0.1  # of Φ beyond what the episodes show


@dataclass(frozen=True)
class _Seen:
    """Vertex tracks (B, T, V, 3) and Φ (B, n, 2) of episodes of one length."""

    paths: Array
    phis: Array


def fit_chain(episodes: list[Array], phis: list[Array], spec: GraphSpec, history: int) -> ChainPrior | None:
    """The chain of vertex tracks (T, V, 3) and their log property ratios (n, 2 or more).

    None where the body is no straight line at rest or no grip holds it: that is no rope.

    Args:
        episodes: vertex tracks (T, V, 3) [m], object vertices first.
        phis: log property ratios of each (n, 2 or more).
        spec: the graph.
        history: h.
    """
    along = arc_lengths(spec)
    if along is None:
        return None
    n, length = spec.object_count, float(np.ptp(along))
    sampled = np.concatenate([episode[::5] for episode in episodes]).astype(np.float64)
    held = held_vertices(spec, sampled, length)
    if not (held.owner >= 0).any() or (held.owner >= 0).all():
        return None
    seen = _of_one_length(episodes, phis, history)
    if seen is None:
        return None
    count = len(seen.paths)
    taught = _part(seen, slice(0, min(FITTED, max(1, count // 2))))
    judged = _part(seen, slice(len(taught.paths), len(taught.paths) + FITTED)) if count > 1 else taught
    found: list[tuple[float, ChainPrior]] = []
    for segments in (some for some in SEGMENTS if 2 * some <= n):
        layout = lay_out(along, held, segments)
        reach = np.array(
            [np.abs(np.stack([layout.share @ phi[:, k] for phi in phis])).max() + MARGIN for k in range(2)]
        )
        prior = _fit(layout, partial(_chain_at, layout=layout, dt_s=spec.dt_s, reach=reach), taught, history)
        found.append((_error(prior, judged, history), prior))
    best = min(found, key=lambda one: one[0], default=None)
    return None if best is None or not np.isfinite(best[0]) else best[1]


def _fit(
    layout: ChainLayout, build: Callable[[Array], ChainPrior], taught: _Seen, history: int
) -> ChainPrior:
    """Least squares over windows that grow; the physics with the least error over whole episodes."""
    n, length = layout.spread.shape[0], float(np.ptp(layout.nodes))

    def miss(parameters: Array, windows: _Seen) -> Array:
        gap = (_rolled(build(parameters), windows, history) - windows.paths)[
            :, history + 1 :, :n:EVERY_VERTEX
        ]
        missed: Array = (
            np.nan_to_num(np.clip(gap, -length, length), nan=length).ravel().astype(float) / length
        )
        return missed

    def fitted(start: Array, windows: _Seen, soft: bool) -> tuple[float, Array]:
        answer = least_squares(
            miss,
            np.clip(start, LOW + 1e-3, HIGH - 1e-3),
            args=(windows,),
            bounds=(LOW, HIGH),
            x_scale=SIZES,
            diff_step=1e-2,
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            max_nfev=12,
            loss="soft_l1" if soft else "linear",
            f_scale=SOFT,
        )
        return float(answer.cost), answer.x

    single = _windows(taught, history, WINDOWS[0], 7)
    starts = [
        np.array([np.log(20.0), np.log(b * length**3), np.log(5e-3), np.log(0.1), 0.0, 0.0, -0.5])
        for b in STARTS
    ]
    parameters = min((fitted(start, single, soft=False) for start in starts), key=lambda one: one[0])[1]
    longest = taught.paths.shape[1] - history - 1
    best = (np.inf, build(parameters))
    for ticks in (*(t for t in WINDOWS[1:] if t < longest), longest):
        parameters = fitted(parameters, _windows(taught, history, ticks, max(ticks, 20)), soft=True)[1]
        prior = build(parameters)
        best = min(best, (_error(prior, taught, history), prior), key=lambda one: one[0])
    return best[1]


def _chain_at(parameters: Array, *, layout: ChainLayout, dt_s: float, reach: Array) -> ChainPrior:
    return chain_of(layout, _physics(parameters), dt_s, reach)


def _physics(parameters: Array) -> ChainPhysics:
    wave, bending, friction, drag = (float(value) for value in np.exp(parameters[:4]))
    return ChainPhysics(wave, bending, friction, drag, G * parameters[4:])


def _rolled(prior: ChainPrior, seen: _Seen, history: int) -> Array:
    """All vertices (B, T, V, 3), open loop from the first h + 1 frames."""
    n = seen.phis.shape[1]
    start = seen.paths[:, : history + 1, :n]
    return ChainRoller(prior, history).run(start, seen.paths[:, :, n:], seen.phis)


def _error(prior: ChainPrior, seen: _Seen, history: int) -> float:
    """Mean distance [m] of object vertices over whole episodes; infinite where one left the numbers."""
    gap = (_rolled(prior, seen, history) - seen.paths)[:, :, : seen.phis.shape[1]]
    mean = float(np.linalg.norm(gap.astype(np.float64), axis=3).mean())
    return mean if np.isfinite(mean) else np.inf


def _of_one_length(episodes: list[Array], phis: list[Array], history: int) -> _Seen | None:
    """The first of the episodes that are no shorter than the median one, cut to that length."""
    frames = int(np.median([len(episode) for episode in episodes]))
    if frames < history + 3:
        return None
    taken = [k for k, episode in enumerate(episodes) if len(episode) >= frames][: 2 * FITTED]
    paths = np.stack([np.asarray(episodes[k][:frames], dtype=np.float32) for k in taken])
    return _Seen(paths, np.stack([np.asarray(phis[k][:, :2], dtype=np.float32) for k in taken]))


def _part(seen: _Seen, taken: slice) -> _Seen:
    return _Seen(seen.paths[taken], seen.phis[taken])


def _windows(seen: _Seen, history: int, ticks: int, every: int) -> _Seen:
    """Windows of history + 1 + ``ticks`` frames, one ``every`` so many frames of each episode."""
    frames = history + 1 + ticks
    firsts = range(0, seen.paths.shape[1] - frames + 1, every)
    paths = np.concatenate([seen.paths[:, first : first + frames] for first in firsts])
    return _Seen(paths, np.tile(seen.phis, (len(firsts), 1, 1)))
