"""Spans of an episode in which the same grips hold, and training of one world model on each set of grips.

``holding`` (T, G) uint8 of an episode: ``holding[t, g]`` is 1 where grip g holds during the tick from t to t + 1; the
last row repeats the one before it and stands for no tick. Episodes without that array: every grip holds all the time.
While a grip is open its ``controllers`` go along with the material that it held.

A world model knows the grips that hold: its graph has control vertices of these alone, so a change of the set is a
change of the model. What it learns from are the spans of its set, each with the h frames before it as history: the
steps of the span, and none of another one. The first of them starts from frames in which other grips held, as the
first step after a change does in a rollout (``physworld.worldmodel.holding.rollout``).

Legend: T frames, G grips, K controllers, h history.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from physworld.arrays import Array
from physworld.worldmodel.dataset import Track, read_track
from physworld.worldmodel.errors import DatasetUnusable
from physworld.worldmodel.model.config import TrainingConfig, WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.properties import PROPERTIES, PhiColumn
from physworld.worldmodel.training import TrainingResult, train

Grips = tuple[int, ...]
"""Numbers of the grips that hold, ascending, in the order of the twin's ``controller_groups``."""

FULL_WINDOWS = 0.75  # share of the spans that are at least as long as a training window
_OVER_TIME = ("times", "particles", "vertices", "controllers")


@dataclass(frozen=True)
class Span:
    """Steps ``first`` … ``end`` - 1, from frame ``first`` to frame ``end``, in which exactly ``grips`` hold."""

    grips: Grips
    first: int
    end: int


def every_grip(count: int) -> Grips:
    """The set in which all of ``count`` grips hold."""
    return tuple(range(count))


def spans_of(holding: Array) -> list[Span]:
    """The spans of equal rows of ``holding`` (T, G), in order; its last row stands for no step."""
    steps = np.asarray(holding)[:-1] != 0
    changes = 1 + np.flatnonzero(np.any(steps[1:] != steps[:-1], axis=1))
    bounds = [0, *changes.tolist(), len(steps)]
    sets = [tuple(np.flatnonzero(steps[first]).tolist()) for first in bounds[:-1] if len(steps)]
    return [Span(grips, *ends) for grips, ends in zip(sets, pairwise(bounds), strict=False)]


def sets_of(holding: Array) -> list[Grips]:
    """The sets of grips that hold at some step of ``holding`` (T, G), in the order in which they first do."""
    return list(dict.fromkeys(span.grips for span in spans_of(holding)))


def held_tracks(
    spec: GraphSpec,
    arrays: dict[str, Array],
    grips: Grips,
    grip_count: int,
    history: int,
    columns: Sequence[PhiColumn] = PROPERTIES,
    values: Mapping[str, float] | None = None,
) -> list[Track]:
    """The graph's vertices in the spans of an episode in which exactly ``grips`` hold; none where there is no such one.

    A span of steps t0 … t1 - 1 gives the frames max(t0 - h, 0) … t1, if these are h + 2 or more.

    Args:
        spec: the graph, whose control vertices are of ``grips``.
        arrays: the episode's (``physworld.worldmodel.dataset``), with ``holding`` (T, G) or without.
        grips: that hold.
        grip_count: G.
        history: h.
        columns: of Φ.
        values: of those columns that the episode does not hold as a field.

    Raises:
        DatasetUnusable: with the numbers.
    """
    frames = len(arrays["times"])
    holding = arrays.get("holding", np.ones((frames, grip_count), dtype=np.uint8))
    if holding.shape != (frames, grip_count):
        raise DatasetUnusable(
            f"an episode of {frames} frames says of {holding.shape} which of {grip_count} grips hold"
        )
    tracks = []
    for span in spans_of(holding):
        begin = max(span.first - history, 0)
        if span.grips != grips or span.end - begin < history + 1:
            continue
        part = {
            name: array[begin : span.end + 1] if name in _OVER_TIME else array
            for name, array in arrays.items()
        }
        tracks.append(read_track(spec, part, history, columns, values))
    return tracks


def look_ahead_for(tracks: Sequence[Track], history: int, most: int) -> int:
    """Steps that a training on ``tracks`` looks ahead: at most ``most``, and as few as most of the spans have.

    A span that is shorter than a training window is never drawn, and a body that is let go for a moment has short
    ones; so three quarters of the spans are at least as long as a window.
    """
    steps = sorted(len(track.positions) - history - 1 for track in tracks)
    return max(1, min(most, steps[int((1.0 - FULL_WINDOWS) * len(steps))]))


def train_held(
    episodes: Sequence[dict[str, Array]],
    specs: Mapping[Grips, GraphSpec],
    grip_count: int,
    config: WorldModelConfig,
    training: TrainingConfig,
) -> dict[Grips, TrainingResult]:
    """One world model for each set of grips, each trained on the spans of its set.

    Every one takes the same ``training.steps``. Shared out by the frames of each set they would be fewest where they
    are needed most: a body on fewer grips moves more, and each network starts from nothing.

    Args:
        episodes: arrays of each.
        specs: graphs by the grips that hold.
        grip_count: G.
        config: of every network.
        training: of every training, but for a look-ahead that is no longer than most of the spans.

    Raises:
        DatasetUnusable: no episode has a span of one of the sets.
    """
    trained = {}
    for grips, spec in specs.items():
        spans = [held_tracks(spec, arrays, grips, grip_count, config.history) for arrays in episodes]
        known = [track for tracks in spans for track in tracks]
        if not known:
            raise DatasetUnusable(
                f"in none of {len(episodes)} episodes the grips {list(grips)} of {grip_count} hold for a step or more"
            )
        ahead = look_ahead_for(known, config.history, training.look_ahead)
        trained[grips] = train(spans, spec, config, replace(training, look_ahead=ahead))
    return trained
