"""Sightings that no body can explain: a marker that jumps, is taken for another, or a frame that is off as a whole.

A body that an effect moves goes there, and its neighbourhood goes with it; what a tracker gets wrong is there from one
frame to the next. So the residual of a point (measured minus predicted) less that of its neighbours is followed through
its sightings. Where it leaps by far more than it usually changes and than the noise allows, what comes after is kept
only if it is back where the residual was before. The same is asked of the median of all points, of which one frame may
be off. Leaps are rare in a faulty recording; where they are not, motion is what the twin lacks: nothing is left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.estimation.noise import Split
from physworld.scene import Scene

_LEAP = 8.0  # times the usual change of a residual, along any axis
_BACK = 0.5  # of a leap: a residual that is nearer than this to where it was has come back
_RARE = 0.1  # share of the changes that may be leaps
_MOST = 0.25  # share of the sightings that may be left out
_NEIGHBOURS = 6
_FEWEST = 8  # sightings of a point, or frames, that tell what is usual
_QUANTILE, _OF_NORMAL = 0.85, 1.44  # of the size of changes: leaps are rarer, and a body may rest for a while
_NAMED = 6  # faults that are told one by one


@dataclass(frozen=True)
class Faults:
    """Faulty sightings of one recording, (T, N) bool, and what they are, in words; no words where there are none."""

    sightings: Array
    words: str

    def __bool__(self) -> bool:
        return bool(self.sightings.any())


def without_faults(scene: Scene, faults: Faults) -> Scene:
    """The scene without its faulty sightings."""
    return replace(scene, visible=scene.visible & ~faults.sightings)


def find_faults(points: Array, visible: Array, tracks: Array, split: Split, sigma: float) -> Faults:
    """Faulty sightings among the training frames.

    Args:
        points, visible: measured, (T, N, 3) [m] and (T, N).
        tracks: a prediction of the training frames at least, (frames, N, 3) [m].
        split: which frames count.
        sigma: noise [m].
    """
    end = min(split.train[1], len(tracks))
    seen = visible[:end].copy()
    error = np.where(seen[..., None], points[:end] - tracks[:end], np.nan)
    frames = _off_frames(error, seen, sigma)
    seen[frames] = False
    error[frames] = np.nan
    suspects = _markers(error, error, tracks[0], sigma)
    trusted = error.copy()
    for n, off in suspects.items():
        trusted[off, n] = np.nan
    markers = {n: off for n, off in _markers(error, trusted, tracks[0], sigma).items() if n in suspects}
    found = np.zeros(visible.shape, dtype=bool)
    found[frames] = visible[frames]
    for n, off in markers.items():
        found[off, n] = True
    if found.sum() > _MOST * visible[:end].sum():
        return Faults(np.zeros_like(found), "")
    return Faults(found, _words(frames, markers))


def _markers(error: Array, trusted: Array, start: Array, sigma: float) -> dict[int, Array]:
    """Frames (k,) in which points are astray from their neighbours, of whom ``trusted`` (frames, N, 3) is believed."""
    apart = error - _around(trusted, start)
    found = {}
    for n in range(error.shape[1]):
        own = np.flatnonzero(~np.isnan(apart[:, n, 0]))
        runs = _astray(own, apart[own, n], sigma)
        if runs:
            found[n] = np.concatenate([own[first:last] for first, last in runs])
    return found


def _around(error: Array, start: Array) -> Array:
    """Median residual of every point's nearest neighbours, (frames, N, 3); not a number where none of them is seen.

    Without a neighbour 0: there is one point only.
    """
    count = min(_NEIGHBOURS, len(start) - 1)
    if count < 1:
        return np.zeros_like(error)
    near = cKDTree(start).query(start, count + 1)[1][:, 1:]
    theirs = error[:, near]  # (frames, N, count, 3)
    none = np.asarray(np.isnan(theirs).all(axis=2))
    median = np.nanmedian(np.where(none[:, :, None], 0.0, theirs), axis=2)
    return np.where(none, np.nan, median)


def _off_frames(error: Array, seen: Array, sigma: float) -> Array:
    """Frames in which the points are off together, and from which they come back, (k,)."""
    frames = np.flatnonzero(seen.any(axis=1))
    if not len(frames):
        return frames
    middle = np.nanmedian(error[frames], axis=1)
    runs = _astray(frames, middle, sigma / np.sqrt(float(np.median(seen[frames].sum(axis=1)))))
    back = [frames[first:last] for first, last in runs if last < len(frames)]
    return np.concatenate([frames[:0], *back])


def _astray(frames: Array, values: Array, sigma: float) -> list[tuple[int, int]]:
    """Half-open runs of a series (k, 3) at frames (k,) that lie beyond a leap from where it was, and are not back."""
    if len(values) < _FEWEST:
        return []
    change, wait = np.diff(values, axis=0), np.sqrt(np.diff(frames))[:, None]
    usual = np.quantile(np.abs(change) / wait, _QUANTILE, axis=0) / _OF_NORMAL
    leaps = np.any(np.abs(change) > _LEAP * np.maximum(usual * wait, np.sqrt(2.0) * sigma), axis=1)
    if not leaps.any() or leaps.sum() > max(_RARE * len(leaps), 2):
        return []
    edges = [*(np.flatnonzero(leaps) + 1), len(values)]
    home, size, runs = values[edges[0] - 1], 0.0, []
    for first, last in pairwise(edges):
        size = max(size, float(np.linalg.norm(change[first - 1])))
        if float(np.linalg.norm(values[first] - home)) > _BACK * size:
            runs.append((int(first), int(last)))
        else:
            home, size = values[last - 1], 0.0
    return runs


def _words(frames: Array, markers: dict[int, Array]) -> str:
    parts = [f"all points in frame {frame}" for frame in frames]
    parts += [
        f"point {n} in frame {off[0]}"
        if len(off) == 1
        else f"point {n} in {len(off)} frames from {off[0]} on"
        for n, off in markers.items()
    ]
    more = f" and {len(parts) - _NAMED} more" if len(parts) > _NAMED else ""
    return ", ".join(parts[:_NAMED]) + more
