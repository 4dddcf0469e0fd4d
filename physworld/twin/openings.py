"""Where the grips of a twin lead what they hold; when they let go, and what they take hold of again.

A grip holds the material that it holds at the start, and takes hold of the same when it closes again. One that declares
a radius takes what then lies within it, and so may go to another place of the body; one that is open at the start takes
what is nearest to it when it closes. A hand that closes on nothing holds nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.engine.hands import Hand, Taken
from physworld.engine.problem import HeldNodes
from physworld.errors import SceneUnsupported
from physworld.geometry.rigid import rigid_motion
from physworld.scene import Grip
from physworld.twin.grips import gripped_nodes

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_MERGE_S = 1e-6  # times closer than this are one, as for the solver's knots


@dataclass(frozen=True)
class Opening:
    """When a grip is open.

    Attributes:
        open_s: beginning and end of every time that it is [s], in their order; the last end may be infinite.
        radius_m: within which of its control points it takes hold of material [m]; None: see the module's text.
    """

    open_s: tuple[tuple[float, float], ...]
    radius_m: float | None = None

    def closed(self, times: Array) -> Array:
        """Whether it is closed all the way from each of the times (T,) [s] to the next, (T-1,) bool."""
        is_open = np.zeros(len(times) - 1, dtype=bool)
        for begin, end in self.open_s:
            is_open |= (times[1:] > begin + _MERGE_S) & (times[:-1] < end - _MERGE_S)
        return ~is_open


def opening_of(grip: Grip, times: Array) -> Opening | None:
    """When a declared grip is open, on the clock of a recording with frames at ``times`` (T,) [s]; None: never."""
    first, last = float(times[0]), float(times[-1])
    spans = tuple((first + begin, first + end) for begin, end in grip.open_s if first + begin < last)
    return Opening(spans, grip.radius_m) if spans else None


def switch_times(openings: Sequence[Opening | None]) -> Array:
    """Times [s] at which any grip opens or closes, (S,)."""
    ends = [t for one in openings if one is not None for span in one.open_s for t in span if np.isfinite(t)]
    return np.unique(np.array(ends, dtype=float))


def holding(twin: Twin, times: Array) -> Array:
    """Whether each grip holds all the way from each of the times (T,) [s] to the next, (T, G) uint8; the last row is
    that before it.
    """
    found = np.ones((len(times), len(twin.controller_groups)), dtype=np.uint8)
    for number, one in enumerate(twin.openings):
        if one is not None and len(times) > 1:
            closed = one.closed(times)
            found[:, number] = np.append(closed, closed[-1])
    return found


def held_paths(twin: Twin, times: Array, controls: Array) -> HeldNodes:
    """Paths of the held nodes at ``times`` (T,) [s] under control points (T, K, 3) [m]: rigid with their group."""
    numbers, paths = [np.empty(0, dtype=int)], [np.empty((len(times), 0, 3))]
    for group, nodes in zip(twin.controller_groups, twin.held_nodes, strict=True):
        rotation, shift = rigid_motion(twin.controllers_start[group], controls[:, group])
        numbers.append(nodes)
        paths.append(np.einsum("tij,nj->tni", rotation, twin.body.start[nodes]) + shift[:, None])
    positions = np.concatenate(paths, axis=1)
    velocities = np.gradient(positions, times, axis=0, edge_order=2 if len(times) > 2 else 1)
    return HeldNodes(np.concatenate(numbers), positions, velocities, _hands_of(twin, times, controls))


def _hands_of(twin: Twin, times: Array, controls: Array) -> tuple[Hand, ...]:
    """The grips of a twin that open, at knots (T,) [s] under control points (T, K, 3) [m]."""
    found = []
    for number, one in enumerate(twin.openings):
        if one is None:
            continue
        group, closed = twin.controller_groups[number], one.closed(times)
        if closed.all():
            continue
        rotations, shifts = rigid_motion(twin.controllers_start[group], controls[:, group])
        takes = None
        if one.radius_m is not None or not len(twin.held_nodes[number]):
            takes = _takes(twin, Grip(tuple(group.tolist()), radius_m=one.radius_m), controls[:, group])
        found.append(Hand(twin.held_nodes[number], rotations, shifts, closed, takes))
    return tuple(found)


def _takes(twin: Twin, grip: Grip, controls: Array) -> Taken:
    """What a grip with control points (T, k, 3) [m] at the knots takes hold of."""

    def nodes(x: Array, knot: int) -> Array:
        try:
            return gripped_nodes(replace(twin.body, start=x), controls[knot], grip)
        except SceneUnsupported:  # nothing lies within its radius
            return np.empty(0, dtype=int)

    return nodes
