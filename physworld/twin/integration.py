"""A run of a twin before it is run: the problem, the start, the grips' paths and the times at which a solver stops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.engine.problem import HeldNodes, Problem

_MERGE_S = 1e-6  # control and frame times closer than this are one


@dataclass(frozen=True)
class Integration:
    """A run of a twin before it is run.

    Attributes:
        problem: what is integrated.
        velocity: of the nodes at the first knot [m/s], (n, 3).
        held: prescribed nodes at the knots.
        knots: times at which the solver stops [s].
        frame_index: each frame's place among the knots, (T,); -1 before the release.
    """

    problem: Problem
    velocity: Array
    held: HeldNodes
    knots: Array
    frame_index: Array

    def at_frames(self, start: Array, nodes: Array) -> Array:
        """Carriers (T, n, 3) at the frames from those at the knots; before the release they are at ``start`` (n, 3)."""
        held_back = np.repeat(start[None], int(np.sum(self.frame_index < 0)), axis=0)
        return np.concatenate([held_back, nodes[self.frame_index[self.frame_index >= 0]]])


def solver_knots(control_times: Array, frame_times: Array, release: float) -> tuple[Array, Array]:
    """Times at which the solver stops, and each frame's place among them (-1 before the release)."""
    start = max(float(frame_times[0]), release)
    inner = control_times[(control_times > start) & (control_times < frame_times[-1])]
    knots = np.unique(np.concatenate([[start], inner, frame_times[frame_times >= start]]))
    keep = np.concatenate([[True], np.diff(knots) > _MERGE_S])
    knots = knots[keep]
    if len(knots) < 2:
        knots = np.array([start, start + 1e-3])
    index = np.clip(np.searchsorted(knots, frame_times + _MERGE_S, side="right") - 1, 0, len(knots) - 1)
    return knots, np.where(frame_times < start - _MERGE_S, -1, index)
