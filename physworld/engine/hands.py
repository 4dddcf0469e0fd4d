"""Grips that let go and take hold again while a body is integrated.

A grip that always holds prescribes its nodes along paths that are known beforehand. One that opens does so only while
it is closed, and where its material is when it closes is a result of the run. So a run asks at the beginning of every
interval between two knots: nodes of a grip that opens are free from there on, and move on with the velocity that they
have; nodes that it takes hold of follow its rigid motion from the place at which they are found,

    x(t) = R(t) R(c)^T (x(c) - s(c)) + s(t)        R, s: the grip's motion since the start, c: when it closed.

A hand that closes on moving material stops it within one substep, as a rigid jaw does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from physworld.arrays import Array

if TYPE_CHECKING:
    from physworld.engine.problem import HeldNodes

Taken = Callable[[Array, int], Array]
"""Numbers of the nodes (k,) that a grip takes hold of, from nodal positions (n, 3) [m] and the number of the knot."""


@dataclass(frozen=True, eq=False)
class Hand:
    """A grip that opens, at the knots of a run.

    Attributes:
        nodes: that it holds at the first knot, where it is closed there, (k,).
        rotations, shifts: its rigid motion since the start, (T, 3, 3) and (T, 3) [m].
        closed: whether it is closed from each knot to the next, (T-1,) bool.
        takes: which nodes it takes hold of when it closes; None: the same as before.
    """

    nodes: Array
    rotations: Array
    shifts: Array
    closed: Array
    takes: Taken | None = None


class Openings:
    """What is prescribed from knot to knot, for one run of a body.

    Args:
        held: nodes that grips hold at the start, their paths at the knots, and the hands that open.
        times: the knots [s], (T,).
        count: nodes of the body, n.

    Attributes:
        positions, velocities: paths of every node that is or may be prescribed, (T, H, 3) [m], [m/s]; meaningless
            where it is free.
        slots: row of every node of the body in the paths, (n,) int32; -1 where it is free.
    """

    def __init__(self, held: HeldNodes, times: Array, count: int) -> None:
        nodes, positions, velocities = held.nodes, held.positions, held.velocities
        if any(hand.takes is not None for hand in held.hands):
            more = np.setdiff1d(np.arange(count), nodes)
            room = np.zeros((len(times), len(more), 3))
            nodes = np.concatenate([nodes, more])
            positions, velocities = (np.concatenate([path, room], axis=1) for path in (positions, velocities))
        if held.hands:  # the paths are written while the run goes on
            positions, velocities = positions.copy(), velocities.copy()
        self.nodes, self.positions, self.velocities = nodes, positions, velocities
        self._times, self._hands = np.asarray(times, dtype=float), held.hands
        self._rows = np.full(count, -1, dtype=np.int32)
        self._rows[nodes] = np.arange(len(nodes), dtype=np.int32)
        self.slots = np.full(count, -1, dtype=np.int32)
        self.slots[held.nodes] = self._rows[held.nodes]
        self._now = [hand.nodes for hand in self._hands]
        for hand in self._hands:
            if not hand.closed[0]:
                self.slots[hand.nodes] = -1

    def enter(self, knot: int, x: Array) -> bool:
        """Bring ``slots`` and paths to what holds from a knot on; whether anything changed.

        Args:
            knot: its number.
            x: nodal positions there [m], (n, 3).
        """
        if knot == 0:
            return False
        changing = [k for k, hand in enumerate(self._hands) if hand.closed[knot] != hand.closed[knot - 1]]
        for number in changing:
            if not self._hands[number].closed[knot]:
                self.slots[self._now[number]] = -1
        for number in changing:
            if self._hands[number].closed[knot]:
                self._take_hold(number, knot, x)
        return bool(changing)

    def _take_hold(self, number: int, knot: int, x: Array) -> None:
        hand = self._hands[number]
        nodes = hand.nodes if hand.takes is None else hand.takes(x, knot)
        nodes = self._now[number] = nodes[self.slots[nodes] < 0]
        local = (x[nodes] - hand.shifts[knot]) @ hand.rotations[knot]
        rotations, shifts = (motion[knot : len(self._times)] for motion in (hand.rotations, hand.shifts))
        path = np.einsum("tij,nj->tni", rotations, local) + shifts[:, None]
        rows, order = self._rows[nodes], _smooth(len(path))
        self.positions[knot:, rows] = path
        self.velocities[knot:, rows] = np.gradient(path, self._times[knot:], axis=0, edge_order=order)
        self.slots[nodes] = rows


def _smooth(knots: int) -> Literal[1, 2]:
    """Order of one-sided differences that so many knots allow."""
    return 2 if knots > 2 else 1
