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
        held.setdefault(
            "curve", held.get("coiled_curve", np.zeros((0, 0)))
        )  # so named where the chain is coiled
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
        pull, bend, ease = self._moduli(phi)
        push = self._steady(now, window[-1, n:], bend)
        even = 0.5 * (
            self._flow(now, speed, here, slope, turn, pull, bend, ease, push)
            + self._flow(now, -speed, here, -slope, turn, pull, bend, ease, push)
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
        push: Array,
    ) -> Array:
        """Nodes (K, 3) after a tick under a steady ``push``; the driven ones are at here + s slope + s²/2 turn."""
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
            velocity = velocity + step * ((force + push) * ease + self._free * held["gravity"])
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

    def _steady(self, places: Array, controls: Array, bend: Array) -> Array:
        """Force of the natural curvature on the nodes (K, 3); 0 of versions that have none."""
        held = self._held
        if not np.any(held.get("natural", 0.0)):
            return np.zeros_like(places)
        along = _unit(np.diff(places, axis=0))
        (first, grip), (last, other) = held["carry"].astype(int)
        across = np.zeros_like(along)
        across[first] = _across(self._turned(grip, controls, held["normal"][0]), along[first])
        for segment in range(first, len(along) - 1):
            across[segment + 1] = _carried(across[segment], along[segment], along[segment + 1])
        for segment in range(first, 0, -1):
            across[segment - 1] = _carried(across[segment], along[segment], along[segment - 1])
        if grip != other:
            end = _across(self._turned(other, controls, held["normal"][1]), along[last])
            beside = np.cross(along[last], across[last])
            off = np.arctan2(end @ beside, end @ across[last]) - held["twist"][0]
            off = held["between"][:, None] * np.arctan2(np.sin(off), np.cos(off))
            across = np.cos(off) * across + np.sin(off) * np.cross(along, across)
        beside = np.cross(along, across)
        natural = 0.5 * held["natural"][:, :1] * (across[1:] + across[:-1])
        natural = natural + 0.5 * held["natural"][:, 1:] * (beside[1:] + beside[:-1])
        return np.asarray(held["curve"].T @ (bend * natural))

    def _driven(self, controls: Array) -> Array:
        """Places of the driven nodes (K, 3) from control vertices (C, 3)."""
        held, places = self._held, np.zeros((len(self._free), 3))
        for grip in range(len(held["markers"])):
            offset = self._turned(grip, controls, held["offset"])
            places += held["member"][:, grip, None] * (held["anchor"][grip] @ controls + offset)
        return places

    def _turned(self, grip: int, controls: Array, offset: Array) -> Array:
        """Vectors (·, 3) of a grip's frame in the world's axes."""
        held, markers = self._held, self._held["markers"][grip]
        if markers == 1:
            return offset
        along = _unit(held["first"][grip] @ controls)
        if markers == 2:
            axis = held["axis"][grip]
            return _least(np.cross(axis, along), axis @ along, offset)
        normal = _unit(np.cross(along, held["second"][grip] @ controls))
        return np.asarray(offset @ np.stack([along, np.cross(normal, along), normal]))

    def _rigid(self, place: Array, change: Array) -> Array:
        """``change`` of ``place`` without what lengthens segments."""
        along = _unit(np.diff(place, axis=0))
        stretch = (along * np.diff(change, axis=0)).sum(axis=1)
        push = np.pad(along * (self._held["slack"] @ stretch)[:, None], ((1, 1), (0, 0)))
        return np.asarray(change + self._lightness * np.diff(push, axis=0))


def _across(vector: Array, along: Array) -> Array:
    """The unit vector of ``vector`` (3,) without its part along a tangent (3,)."""
    return _unit(vector - (vector @ along) * along)


def _carried(across: Array, along: Array, following: Array) -> Array:
    """A vector (3,) turned by the least rotation from one tangent to another."""
    return _least(np.cross(along, following), float(along @ following), across)


def _least(axis: Array, cosine: float, vector: Array) -> Array:
    """Vectors (·, 3) turned about ``axis`` (3,), whose length is the sine."""
    once = np.cross(axis, vector)
    return np.asarray(vector + once + np.cross(axis, once) / max(1.0 + cosine, LEAN_FLOOR))


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))
