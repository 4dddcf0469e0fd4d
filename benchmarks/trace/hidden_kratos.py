"""Bodies for ``benchmarks.trace.hidden_effects --set hidden_kratos``, which Kratos records and how they move.

Ropes that both ends of are held, thick ropes, lumps in a small grip, slabs that hang by two corners.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from scipy.interpolate import CubicSpline, RectBivariateSpline

from benchmarks.peers.finite_elements import Acting, Floats, Place
from benchmarks.trace.hidden_bodies import (
    FILLING,
    POISSON,
    TOP_M,
    TRACKED,
    Cloth,
    Cord,
    Hand,
    Motion,
    Object,
    Recorder,
)
from physworld.scene import Body

ROPE_POISSON, ELEMENTS = 0.4, 40
_ROPE_TRACKED, _HELD = 40, 3
_CORNER = 2  # cells of a slab that a hand holds


class Strand(Cord):
    """A rope of beams, held at both ends."""

    hands: ClassVar[int] = 2

    def mesh(self, top: Floats, along: Floats) -> Any:
        """Its nodes, and what records them."""
        from benchmarks.peers.kratos_bodies import rod

        return rod(top, along, self.length_m, self.radius_m, self.young_pa, ROPE_POISSON, self.density_kg_m3,
                   ELEMENTS)  # fmt: skip

    def recorder(self, seed: int, rng: np.random.Generator) -> Recorder:
        """Corotational beams; a camera sees places of the axis."""
        top = np.array([0.0, 0.0, TOP_M])
        along = np.array(self.way) / np.linalg.norm(self.way)
        mesh = self.mesh(top, along)
        seen = np.sort(rng.uniform(0.0, 1.0, _ROPE_TRACKED))
        ends = [np.arange(_HELD), len(mesh.nodes) - 1 - np.arange(_HELD)][: self.hands]
        motions = [Motion(10 * seed + g, self.stroke_m, self.turn_rad) for g in range(len(ends))]
        room = self.radius_m * np.sqrt(1.0 - along**2)
        shares = np.linspace(0.0, 1.0, len(mesh.nodes))

        def tracks(acting: Acting, late_s: float, at: Floats) -> Floats:
            nodes = mesh.record(acting, _grips(ends, motions, late_s), at)
            found: Floats = CubicSpline(shares, nodes, axis=1)(seen)
            return found

        hands = [
            Hand(np.array([at.min(axis=0) - room, at.max(axis=0) + room]), at.mean(axis=0), motion)
            for at, motion in zip([mesh.nodes[end] for end in ends], motions, strict=True)
        ]
        return Recorder(hands, tracks, partial(self.inside, along))


class Slab(Cloth):
    """A plate that hangs by two corners."""

    def mesh(self, corner: Floats) -> Any:
        """Its nodes from its lowest corner (3,) [m] on, and what records them."""
        from benchmarks.peers.kratos_bodies import plate

        width, thickness, height = self.size_m
        return plate(corner, width, height, self.cells, thickness, self.young_pa, POISSON, self.density_kg_m3)

    def recorder(self, seed: int, rng: np.random.Generator) -> Recorder:
        """Corotational shells; a camera sees places of the middle surface."""
        width, thickness, height = self.size_m
        corner = np.array([-0.5 * width, 0.0, TOP_M - height])
        mesh = self.mesh(corner)
        across, up = (np.linspace(0.0, 1.0, count + 1) for count in self.cells)
        unit = (mesh.nodes - corner)[:, [0, 2]] / [width, height]
        reach = _CORNER / np.array(self.cells) + 1e-9
        high = unit[:, 1] >= 1.0 - reach[1]
        ends = [np.flatnonzero(high & (unit[:, 0] <= reach[0])),
                np.flatnonzero(high & (unit[:, 0] >= 1.0 - reach[0]))]  # fmt: skip
        motions = [Motion(10 * seed + g, self.stroke_m, 0.0) for g in range(len(ends))]
        seen = rng.uniform(0.0, 1.0, (TRACKED, 2))
        room = np.array([0.0, 0.5 * thickness, 0.0])

        def tracks(acting: Acting, late_s: float, at: Floats) -> Floats:
            nodes = mesh.record(acting, _grips(ends, motions, late_s), at)
            places = nodes.reshape(len(nodes), len(up), len(across), 3)
            return np.stack(
                [
                    np.stack(
                        [
                            RectBivariateSpline(up, across, place[..., c]).ev(seen[:, 1], seen[:, 0])
                            for c in range(3)
                        ],
                        axis=1,
                    )
                    for place in places
                ]
            )

        def inside(r: np.random.Generator) -> Floats:
            low = corner - room
            return low + r.uniform(0.0, 1.0, (FILLING, 3)) * self.size_m

        hands = [
            Hand(
                np.array([mesh.nodes[end].min(axis=0) - room, mesh.nodes[end].max(axis=0) + room]),
                mesh.nodes[end].mean(axis=0), motion,
            )
            for end, motion in zip(ends, motions, strict=True)
        ]  # fmt: skip
        return Recorder(hands, tracks, inside)


@dataclass(frozen=True)
class Lump(Object):
    """A solid of hexahedra, declared and held as ``Object`` is."""

    def recorder(self, seed: int, rng: np.random.Generator) -> Recorder:
        """Hexahedra in the total Lagrangian form; a camera sees places of the surface."""
        from benchmarks.peers.kratos_bodies import block

        mesh = block(self.shape, self.counts, self.young_pa, POISSON, self.density_kg_m3)
        unit = rng.uniform(0.0, 1.0, (TRACKED, 3))
        unit[np.arange(TRACKED), rng.integers(1, 3, TRACKED)] = rng.integers(0, 2, TRACKED)
        nodes, weights = _between(unit, self.counts)
        boxes = [self._box(np.array(box)) for box in self.held]
        ends = [
            np.flatnonzero(np.all((mesh.nodes >= box[0] - 1e-9) & (mesh.nodes <= box[1] + 1e-9), axis=1))
            for box in boxes
        ]
        motions = [Motion(10 * seed + g, self.stroke_m, self.turn_rad) for g in range(len(ends))]

        def tracks(acting: Acting, late_s: float, at: Floats) -> Floats:
            places = mesh.record(acting, _grips(ends, motions, late_s), at)
            return np.einsum("pk,tpki->tpi", weights, places[:, nodes])

        hands = [
            Hand(box, mesh.nodes[end].mean(axis=0), motion)
            for box, end, motion in zip(boxes, ends, motions, strict=True)
        ]
        return Recorder(hands, tracks, lambda r: self.shape(r.uniform(0.0, 1.0, (FILLING, 3))))


@dataclass(frozen=True)
class ThickRope(Lump):
    """A rope of hexahedra, round and straight along x, held at one end: beams that thick do not converge."""

    @property
    def body(self) -> Body:
        """What the scene declares."""
        length, width, _ = self.size_m
        return Body(length_m=length, radius_m=0.5 * width, density_kg_m3=self.density_kg_m3)

    def _box(self, box: Floats) -> Floats:
        return (box - 0.5) * self.size_m + [0.0, 0.0, TOP_M]

    def shape(self, unit: Floats) -> Floats:
        """Squares across the rope become discs of the same places of the edge."""
        side = 2.0 * unit[:, 1:] - 1.0
        reach = np.linalg.norm(side, axis=1, keepdims=True)
        disc = side * np.max(np.abs(side), axis=1, keepdims=True) / np.maximum(reach, 1e-12)
        return np.hstack([unit[:, :1] - 0.5, 0.5 * disc]) * self.size_m + [0.0, 0.0, TOP_M]


def _grips(ends: list[np.ndarray], motions: list[Motion], late_s: float) -> list[tuple[Any, Place]]:
    return [(end, partial(motion.place, late_s)) for end, motion in zip(ends, motions, strict=True)]


def _between(unit: Floats, counts: tuple[int, int, int]) -> tuple[np.ndarray, Floats]:
    """Nodes (N, 8) of the hexahedra that hold places (N, 3) of the unit cube, and their trilinear weights (N, 8)."""
    size = np.array(counts)
    cell = np.minimum((unit * size).astype(int), size - 1)
    share = unit * size - cell
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    nodes = np.ravel_multi_index(np.moveaxis(cell[:, None] + corners, -1, 0), size + 1)
    weights = np.prod(np.where(corners == 1, share[:, None], 1.0 - share[:, None]), axis=-1)
    return nodes, weights


KRATOS: dict[str, Strand | Slab | Lump] = {
    "taut rope": Strand(0.42, 0.006, 1e6, 900.0, (1.0, 0.0, 0.0), (0.004, 0.03, 0.02), 0.0),
    "thick rope": ThickRope("rope", (0.36, 0.032, 0.032), (24, 4, 4), 3e5, 800.0,
                            (((0.0, 0.0, 0.0), (1.0 / 12, 1.0, 1.0)),), 0.03, 0.15, around=True),
    "lump": Lump("blob", (0.2, 0.1, 0.09), (12, 6, 6), 5e4, 540.0,
                 (((0.0, 1 / 3, 1 / 3), (1 / 6, 2 / 3, 2 / 3)),), 0.02, round=True, around=True),
    "hung slab": Slab((0.22, 0.015, 0.2), (10, 9), 2.6e5, 350.0, (0.004, 0.03, 0.02)),
}  # fmt: skip
