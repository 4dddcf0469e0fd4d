"""Labels that changed hands: a marker that jumps to where another one was to be expected.

Each marker's next place is expected on a straight line through its last two. Where it turns up at the place that is
expected of another marker, far from its own, and that other one is lost or turns up at its place, its label was put on
the other one; from there until its next jump its samples are not seen. A marker that is wrong for most of the time is
dropped. A grid whose nodes all move on by one is none of this: the tracker found the object anew.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array

NEARER = 4.0
"""How much nearer to another's expected place than to its own."""
FAR_SIGMAS = 8.0
JUMP_SHARE = 0.25
"""Of the distance between the two, that a jump must be at least."""
MOST_WRONG = 0.5


def swapped(places: Array, seen: Array, sigma: Array) -> Array:
    """The samples whose label is on another marker, (T, N) bool.

    Args:
        places: (T, N, 3) in any unit.
        seen: (T, N) bool.
        sigma: noise of each marker, (N,).
    """
    wrong = np.zeros(seen.shape, dtype=bool)
    if len(places) < 3 or places.shape[1] < 2:
        return wrong

    def expected_at(t: int) -> Array:
        """Places (N, 3) in frame t + 2, from the two frames before."""
        return np.asarray(2.0 * places[t + 1] - places[t])

    known = seen[1:-1] & seen[:-2]
    off = np.stack([np.linalg.norm(places[t + 2] - expected_at(t), axis=1) for t in range(len(places) - 2)])
    both = known & seen[2:]
    usual = np.array(
        [np.median(off[both[:, i], i]) if both[:, i].any() else 0.0 for i in range(seen.shape[1])]
    )
    suspect = both & (off > NEARER * usual + FAR_SIGMAS * sigma)
    since = np.full(seen.shape[1], -1)
    """Frame in which a marker's label went to another; -1: it is right."""
    for t, i in np.argwhere(suspect):
        frame = t + 2
        if since[i] >= 0:
            if frame > since[i] + 1:  # the frame after a jump is never where it is expected
                wrong[since[i] : frame, i] = True
                since[i] = -1
            continue
        expected = expected_at(t)
        there = np.linalg.norm(expected - places[frame, i], axis=1)
        there[~known[t]] = np.inf
        there[i] = np.inf
        j = int(np.argmin(there))
        apart = float(np.linalg.norm(expected[j] - expected[i])) if np.isfinite(there[j]) else np.inf
        back = float(np.linalg.norm(places[frame, j] - expected[i]))
        gone = not seen[frame, j] or NEARER * back < off[t, j]
        if NEARER * there[j] < off[t, i] and off[t, i] > JUMP_SHARE * apart and gone:
            since[i] = frame
    for i in np.flatnonzero(since >= 0):
        wrong[since[i] :, i] = True
    return wrong


def lost(wrong: Array, seen: Array) -> Array:
    """Markers (N,) that are wrong for most of the time that they are seen."""
    share = (wrong & seen).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    return np.asarray(share > MOST_WRONG)
