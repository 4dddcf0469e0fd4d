"""A grip that takes hold again in a rollout: of the material where the model predicted it.

World models learn from demonstrations in which a grip, whenever it holds, stands to the held material as at the
episode's start. In a rollout the model itself has predicted where that material is when the grip closes, which is not
quite where it was when the hand's path was recorded or planned, and a person's hand closes wherever it is. What a real
grip does then is hold what is there: from closing on the material moves with the hand. So

    c'(t) = H(t) D H(t)⁻¹ c(t)      t ≥ closing,      D = H⁻¹ L H at closing
    c'(t) = M(t) c'(closing)        while it was open

with H(t) the rigid motion of the hand's controllers c since the start, L the rigid motion that takes the grip's
vertices from where H would have them at closing to where they are predicted, and M(t) the rigid motion of these
vertices from closing back to t. Where prediction and hand agree L is the identity, and nothing changes.

Vertices on a line, as a rope's are, leave the turn about it open: L is then the least rotation, so that the hand's own
turn about the rope stays. NumPy only.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.geometry.rigid import rigid_motion
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.priors.chain_layout import arc_lengths

FEWEST, MOST = 4, 12  # vertices of a body that show how held material lies
ON_A_ROPE = 2
BESIDE_A_LINE = 0.2  # second over first singular value of their places, below which they lie almost on a line


def vertices_near(spec: GraphSpec, start: Array, controllers: Array) -> Array:
    """Object vertices that show how the material of a grip lies, (m,): the nearest, and as many as span a pose.

    Args:
        spec: the graph.
        start: object vertices at the start [m], (n, 3).
        controllers: of the grip at the start [m], (k, 3).
    """
    gaps = np.linalg.norm(start[:, None] - controllers[None], axis=2).min(axis=1)
    nearest = np.argsort(gaps, kind="stable")
    if arc_lengths(spec) is not None:
        return nearest[:ON_A_ROPE]
    for count in range(FEWEST, min(MOST, len(nearest)) + 1):
        places = start[nearest[:count]]
        sizes = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        if sizes[1] >= BESIDE_A_LINE * sizes[0]:
            return nearest[:count]
    return nearest[:FEWEST]


def taken_hold(path: Array, hand: Array, opened: int) -> Array:
    """Controllers from frame ``opened`` + 1 on of a grip that holds from the last frame of ``path`` on [m].

    Args:
        path: the grip's vertices (:func:`vertices_near`) from the start to the frame of closing [m], (S, m, 3).
        hand: the grip's controllers as they were recorded or planned [m], (T, k, 3), T ≥ S.
        opened: frame at which it let go, less than S - 1.

    Returns:
        (T - opened - 1, k, 3).
    """
    closed = len(path) - 1
    turns, shifts = rigid_motion(hand[0], hand[closed:])
    expected = path[0] @ turns[0].T + shifts[0]
    lifts, moves = rigid_motion(expected, path[closed:])
    # D in the hand's own coordinates, in which its controllers are what they were at the start, but for noise
    own = np.einsum("tji,tkj->tki", turns, hand[closed:] - shifts[:, None])
    turn = turns[0].T @ lifts[0] @ turns[0]
    shift = turns[0].T @ (lifts[0] @ shifts[0] + moves[0] - shifts[0])
    held = np.einsum("tij,tkj->tki", turns, own @ turn.T + shift) + shifts[:, None]
    back, away = rigid_motion(path[closed], path[opened + 1 : closed])
    open_path = np.einsum("tij,kj->tki", back, held[0]) + away[:, None]
    return np.concatenate([open_path, held])
