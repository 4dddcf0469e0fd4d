"""The chain prior of a rope's world model in NumPy: where its vertices will be one clock tick later.

Equations and tensors are those of ``physworld.worldmodel.priors.chain``; this file is written from them alone, in
double precision.

Legend: n object vertices, C control vertices, G grips, K nodes along the rope.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from physworld_client.types import Array

CALMINGS = 8
LEAN_FLOOR = 1e-6
LENGTH_FLOOR_M2 = 1e-24


class Chain:
    """Point masses along the centre line, moved through one tick both ways in time."""

    def __init__(self, tensors: Mapping[str, Array]) -> None:
        held = {
            name[6:]: value.astype(np.float64) for name, value in tensors.items() if name.startswith("prior.")
        }
        self._held = held
        self._substeps = int(held["substeps"][0])
        self._free = (held["member"].sum(axis=1) == 0).astype(np.float64)[:, None]
        self._lightness = self._free / held["mass"][:, None]

    def ahead(self, window: Array, control_next: Array, phi: Array) -> Array:
        """x̂^{t+1} of the object vertices [m], (n, 3), from (h+1, V, 3), (C, 3) and (n, 2)."""
        held, n = self._held, len(phi)
        ahead, here, behind = (self._driven(c) for c in (control_next, window[-1, n:], window[-2, n:]))
        now, before = self._nodes(window[-1, :n], here), self._nodes(window[-2, :n], behind)
        speed = now - before
        if len(window) > 2:
            older = self._nodes(window[-3, :n], self._driven(window[-3, n:]))
            speed = 1.5 * speed - 0.5 * (before - older)
        speed = self._free * self._rigid(now, held["smooth"] @ speed)
        slope, turn = 0.5 * (ahead - behind), ahead - 2.0 * here + behind
        moduli = self._moduli(phi)
        even = 0.5 * (
            self._flow(now, speed, here, slope, turn, *moduli)
            + self._flow(now, -speed, here, -slope, turn, *moduli)
        )
        gone = self._rigid(even, even - self._free * before - behind)
        return np.asarray(held["spread"] @ (even + held["keep"] @ gone))

    def _flow(
        self,
        place: Array,
        velocity: Array,
        here: Array,
        slope: Array,
        turn: Array,
        pull: Array,
        bend: Array,
        ease: Array,
    ) -> Array:
        """Nodes (K, 3) after a tick; the driven ones are at here + s slope + s²/2 turn."""
        held, step = self._held, 1.0 / self._substeps
        dash, before = held["dash"][:, None] * self._substeps, None
        for substep in range(self._substeps):
            pulled = np.diff(place, axis=0)
            size = np.sqrt((pulled**2).sum(axis=1, keepdims=True) + LENGTH_FLOOR_M2)
            tension = pull * (1.0 - held["length"][:, None] / size)
            if before is not None:
                tension = tension + dash * (size - before) / size
            before = size
            drawn = np.pad(tension * pulled, ((1, 1), (0, 0)))
            force = np.diff(drawn, axis=0) - held["curve"].T @ (bend * (held["curve"] @ place))
            velocity = velocity + step * (force * ease + self._free * held["gravity"])
            now = step * (substep + 1)
            if (substep + 1) % (self._substeps // CALMINGS) == 0:
                whole = velocity + (1.0 - self._free) * (slope + now * turn)
                velocity = self._free * (held["calm"] @ whole)
            place = self._free * (place + step * velocity) + here + now * (slope + 0.5 * now * turn)
        return place

    def _nodes(self, vertices: Array, driven: Array) -> Array:
        return np.asarray(self._held["read"] @ vertices + self._held["hold"] @ driven)

    def _moduli(self, phi: Array) -> tuple[Array, Array, Array]:
        """Pull (K-1, 1), bend (K-2, 1) and ease (K, 1) of Φ."""
        held = self._held
        stiff, heavy = (held["share"] @ phi.astype(np.float64)).T
        stiff = np.clip(stiff, -held["reach"][0], held["reach"][0])
        heavy = np.clip(heavy, -held["reach"][1], held["reach"][1])
        pull = held["pull"] * np.exp(0.5 * (stiff[1:] + stiff[:-1]))
        bend = held["bend"] * np.exp(stiff[1:-1])
        return pull[:, None], bend[:, None], self._lightness * np.exp(-heavy)[:, None]

    def _driven(self, controls: Array) -> Array:
        """Places of the driven nodes (K, 3) from control vertices (C, 3)."""
        held, places = self._held, np.zeros((len(self._free), 3))
        for grip, markers in enumerate(held["markers"]):
            offset = held["offset"]
            if markers > 1:
                along = _unit(held["first"][grip] @ controls)
                if markers == 2:
                    axis = held["axis"][grip]
                    turn = np.cross(axis, along)
                    once = np.cross(turn, offset)
                    offset = offset + once + np.cross(turn, once) / max(1.0 + axis @ along, LEAN_FLOOR)
                else:
                    normal = _unit(np.cross(along, held["second"][grip] @ controls))
                    offset = offset @ np.stack([along, np.cross(normal, along), normal])
            places += held["member"][:, grip, None] * (held["anchor"][grip] @ controls + offset)
        return places

    def _rigid(self, place: Array, change: Array) -> Array:
        """``change`` of ``place`` without what lengthens segments."""
        along = _unit(np.diff(place, axis=0))
        stretch = (along * np.diff(change, axis=0)).sum(axis=1)
        push = np.pad(along * (self._held["slack"] @ stretch)[:, None], ((1, 1), (0, 0)))
        return np.asarray(change + self._lightness * np.diff(push, axis=0))


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))
