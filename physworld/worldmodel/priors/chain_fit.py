"""Fitting a chain prior to episodes: speed of stretch waves, bending, friction, drag, gravity, natural curvature.

Least squares on what the chain predicts, open loop: one tick at first, from two stiffnesses, then longer and longer
windows up to whole episodes. The natural curvature is found between two such fits, by linear least squares on what is
left of single ticks: its force stays through a tick, so that places are nearly linear in it. How many segments the
chain has, and whether it is curved, is chosen on episodes that the fit did not see.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import least_squares

from physworld.arrays import Array
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.native.chain_native import ChainRoller
from physworld.worldmodel.priors.chain import ChainPhysics, ChainPrior, chain_of
from physworld.worldmodel.priors.chain_layout import ChainLayout, arc_lengths, held_vertices, lay_out
from physworld.worldmodel.priors.chain_step import ChainStep

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
ROUNDS = 2  # of curvature and the rest in turns
CLEARLY = 0.95  # times the error of a straight chain: what a curved one must stay below to be taken
COILS = 1.0  # standard deviation of the natural curvature before anything is seen: so many rings of the rope's length


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

        def fitted(
            curvature: tuple[Array, Array] | None, layout: ChainLayout = layout, reach: Array = reach
        ) -> ChainPrior:
            def build(parameters: Array) -> ChainPrior:
                prior = chain_of(layout, _physics(parameters), spec.dt_s, reach)
                return replace(prior, natural=curvature[0], twist=curvature[1]) if curvature else prior

            return _fit(layout, build, taught, history)

        prior = fitted(None)
        found.append((_error(prior, judged, history), prior))
        for _ in range(ROUNDS):
            prior = fitted(_curvature(prior, taught, history))
            found.append((_error(prior, judged, history) / CLEARLY, prior))
    best = min(found, key=lambda one: one[0], default=None)
    return None if best is None or not np.isfinite(best[0]) else best[1]


def _curvature(prior: ChainPrior, taught: _Seen, history: int) -> tuple[Array, Array]:
    """``natural`` and ``twist`` that leave least of single ticks, the rest of the prior as it is."""
    single = _windows(taught, history, 1, WINDOWS[0] + 6)
    paths = torch.as_tensor(single.paths).permute(1, 2, 0, 3)
    phi, n, inner = torch.as_tensor(single.phis).transpose(0, 1), single.phis.shape[1], len(prior.bend)
    step = ChainStep(prior, history)

    def left(natural: Array) -> Array:
        step.natural, step.curved = torch.as_tensor(natural, dtype=torch.float32).reshape(inner, 2), True
        gap = paths[-1, :n] - step(paths[:-1], paths[-1, n:], phi)
        missed: Array = gap.numpy().astype(np.float64).ravel()
        return missed

    with torch.no_grad():
        angle = step.frames(*step.nodes_and_controls(paths[-2]))[2].numpy()
        twist = np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())
        step.twist = torch.as_tensor([twist], dtype=torch.float32)
        without = left(np.zeros(2 * inner))
        slopes = np.stack([left(unit) - without for unit in np.eye(2 * inner)], axis=1)
    square = slopes.T @ slopes
    ring = 2.0 * np.pi * COILS / float(prior.length.sum())
    ridge = (
        n * np.square(without).mean() / ring**2
    )  # what is left of a tick is one error, not one of every vertex
    natural = np.linalg.solve(square + ridge * np.eye(len(square)), -slopes.T @ without).reshape(inner, 2)
    return natural.astype(np.float32), np.array([twist], np.float32)


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
