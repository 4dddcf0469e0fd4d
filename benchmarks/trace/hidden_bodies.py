"""Bodies for ``benchmarks.trace.hidden_effects``, recorded by finite elements, PyElastica or MuJoCo, and how they
move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.peers.finite_elements import Acting, Elements, Floats, Place, record
from physworld.geometry.sheet_body import SHEET_KINDS
from physworld.scene import Body, Ground

TOP_M = 0.5  # height at which bodies are held
POISSON, TRACKED = 0.35, 120
_ROPE_TRACKED, _ROPE_POISSON, FILLING = 40, 0.4, 3000
_RAMP_S = 0.15
_CLOTH_TRACKED, _CLOTH_STEPS = 300, 460
_BLOCK_TRACKED, _BLOCK_STEPS = 200, 240


class Motion:
    """Ways of a grip from rest: two sines along every axis, and a turn about the second one.

    Args:
        stroke_m: of the sines, at most; along every axis or along each.
    """

    def __init__(self, seed: int, stroke_m: float | tuple[float, ...], turn_rad: float) -> None:
        rng = np.random.default_rng(seed)
        self.size = rng.uniform(0.3, 1.0, (2, 3)) * np.asarray(stroke_m)
        self.pace = rng.uniform(((3.0,), (8.0,)), ((7.0,), (13.0,)), (2, 3))  # rad/s
        self.phase = rng.uniform(0.0, 2 * np.pi, (2, 3))
        self.turn, self.turning = turn_rad * rng.uniform(0.5, 1.0), rng.uniform(3.0, 6.0)

    def place(self, late_s: float, time: float) -> tuple[Floats, Floats]:
        """Rotation (3, 3) and shift (3,) [m] of what follows the controllers so late."""
        since = max(time - late_s, 0.0)
        gain = 1.0 - np.exp(-((since / _RAMP_S) ** 2))
        shift = gain * np.sum(self.size * np.sin(self.pace * since + self.phase), axis=0)
        turn = Rotation.from_rotvec([0.0, gain * self.turn * np.sin(self.turning * since), 0.0])
        return turn.as_matrix(), shift


@dataclass(frozen=True)
class Hand:
    """A grip: its box at rest (2, 3) [m], the point that it turns about (3,) [m], and how it moves."""

    box: Floats
    centre: Floats
    motion: Motion


@dataclass(frozen=True)
class Recorder:
    """One body before a camera.

    Attributes:
        hands: its grips.
        tracks: points (T, N, 3) [m] of what acts, of hands that follow so late [s], at evenly spaced times (T,) [s].
        inside: points that fill the body at rest, (M, 3) [m], drawn from a generator.
        rough: as ``tracks``, cheaper and less right, to tell by how much an effect shows; None: ``tracks`` tells.
    """

    hands: list[Hand]
    tracks: Callable[[Acting, float, Floats], Floats]
    inside: Callable[[np.random.Generator], Floats]
    rough: Callable[[Acting, float, Floats], Floats] | None = None


@dataclass(frozen=True)
class Object:
    """A body to record.

    Attributes:
        kind: of the scene.
        size_m: (3,), of the box around it.
        counts: elements.
        young_pa, density_kg_m3: of the material; density is declared.
        held: boxes of the unit cube that grips hold, (2, 3) each.
        stroke_m, turn_rad: how far grips go, along every axis or along each, and turn.
        round: the section across the first axis shrinks towards the ends, as an ellipsoid's with blunt ends does.
        around: a grip's box goes around all that its box of the cube becomes, not from its first corner to its last.
    """

    kind: str
    size_m: tuple[float, float, float]
    counts: tuple[int, int, int]
    young_pa: float
    density_kg_m3: float
    held: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]
    stroke_m: float | tuple[float, ...]
    turn_rad: float = 0.0
    round: bool = False
    around: bool = False

    @property
    def body(self) -> Body:
        """What the scene declares."""
        thin = self.kind in SHEET_KINDS
        return Body(size_m=np.array(self.size_m), thickness_m=min(self.size_m) if thin else None,
                    density_kg_m3=self.density_kg_m3)  # fmt: skip

    def recorder(self, seed: int, rng: np.random.Generator) -> Recorder:
        """Finite elements; a camera sees places of the surface, of a sheet any."""
        elements = Elements(self.counts, self.shape, self.young_pa, POISSON, self.density_kg_m3)
        units = rng.uniform(0.0, 1.0, (TRACKED, 3))
        if self.kind not in SHEET_KINDS:
            side = rng.integers(1, 3, TRACKED)
            units[np.arange(TRACKED), side] = rng.integers(0, 2, TRACKED)
        nodes, weights = elements.weights(np.clip(units, 1e-6, 1 - 1e-6))
        motions = [Motion(10 * seed + g, self.stroke_m, self.turn_rad) for g in range(len(self.held))]
        boxes = [self._box(np.array(box)) for box in self.held]
        held = [
            np.flatnonzero(np.all((elements.nodes >= b[0] - 1e-9) & (elements.nodes <= b[1] + 1e-9), axis=1))
            for b in boxes
        ]

        def tracks(acting: Acting, late_s: float, at: Floats) -> Floats:
            grips: list[tuple[Any, Place]] = [
                (h, partial(m.place, late_s)) for h, m in zip(held, motions, strict=True)
            ]
            return np.einsum("pk,tpki->tpi", weights, record(elements, acting, grips, at)[:, nodes])

        hands = [
            Hand(box, elements.nodes[h].mean(axis=0), motion)
            for box, h, motion in zip(boxes, held, motions, strict=True)
        ]
        return Recorder(hands, tracks, lambda r: self.shape(r.uniform(0.0, 1.0, (FILLING, 3))))

    def _box(self, box: Floats) -> Floats:
        """Of a grip, (2, 3) [m], that holds this box of the unit cube."""
        corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
        shaped = self.shape(corners)
        return np.array([shaped.min(axis=0), shaped.max(axis=0)]) if self.around else self.shape(box)

    def shape(self, unit: Floats) -> Floats:
        """Places at rest [m] of points (N, 3) of the unit cube."""
        centred = unit - 0.5
        if self.round:
            width = np.sqrt(1.0 - (1.8 * centred[:, :1]) ** 2 * 0.9)
            centred = np.hstack([centred[:, :1], centred[:, 1:] * width])
        return centred * self.size_m + [0.0, 0.0, TOP_M]


@dataclass(frozen=True)
class Cord:
    """A rope that hangs askew from a hand.

    Attributes:
        kind: of the scene.
        young_pa, density_kg_m3: of the material; density is declared.
        way: from the hand on, (3,).
        stroke_m, turn_rad: how far the hand goes, along every axis or along each, and turns.
    """

    length_m: float
    radius_m: float
    young_pa: float
    density_kg_m3: float
    way: tuple[float, float, float]
    stroke_m: float | tuple[float, ...]
    turn_rad: float
    kind: str = "rope"

    @property
    def body(self) -> Body:
        """What the scene declares."""
        return Body(length_m=self.length_m, radius_m=self.radius_m, density_kg_m3=self.density_kg_m3)

    def recorder(self, seed: int, rng: np.random.Generator) -> Recorder:
        """A Cosserat rod; a camera sees points around its surface."""
        from benchmarks.peers.elastica_ropes import Rope

        rope = Rope(
            self.length_m, self.radius_m, np.array([0.0, 0.0, TOP_M]), np.array(self.way), self.young_pa, _ROPE_POISSON,
            self.density_kg_m3,
        )  # fmt: skip
        seen = rng.uniform((0.0, 0.0), (1.0, 2.0 * np.pi), (_ROPE_TRACKED, 2))
        motion = Motion(10 * seed, self.stroke_m, self.turn_rad)
        room = self.radius_m * np.sqrt(1.0 - rope.along**2)  # of the held part, which ends across its axis
        box = np.array([rope.held.min(axis=0) - room, rope.held.max(axis=0) + room])

        def tracks(acting: Acting, late_s: float, at: Floats) -> Floats:
            return rope.record(acting, partial(motion.place, late_s), at, seen)

        return Recorder([Hand(box, rope.held[0], motion)], tracks, partial(self.inside, rope.along))

    def inside(self, along: Floats, rng: np.random.Generator) -> Floats:
        """Points that fill the rope at rest, which goes along a unit vector (3,) from its top: (M, 3) [m]."""
        out = rng.normal(size=(FILLING, 3))
        out -= (out @ along)[:, None] * along
        reach = np.sqrt(rng.uniform(size=(FILLING, 1)))
        out *= self.radius_m * reach / np.linalg.norm(out, axis=1, keepdims=True)
        return [0.0, 0.0, TOP_M] + self.length_m * rng.uniform(size=(FILLING, 1)) * along + out


@dataclass(frozen=True)
class Cloth:
    """A sheet of triangles that hangs by two corners, two cells of each in a hand.

    Attributes:
        size_m: width, thickness and height.
        cells: across and up.
        young_pa, density_kg_m3: of the material; density is declared.
        stroke_m: how far hands go along the axes; where they approach each other, it folds and folds as it likes.
        kind: of the scene.
    """

    size_m: tuple[float, float, float]
    cells: tuple[int, int]
    young_pa: float
    density_kg_m3: float
    stroke_m: tuple[float, float, float]
    kind: str = "sheet"

    @property
    def body(self) -> Body:
        """What the scene declares."""
        return Body(
            size_m=np.array(self.size_m), thickness_m=self.size_m[1], density_kg_m3=self.density_kg_m3
        )

    def recorder(self, seed: int, rng: np.random.Generator) -> Recorder:
        """MuJoCo flex; a camera sees any places of it."""
        from benchmarks.peers.flex_cloths import Mesh

        width, thickness, height = self.size_m
        mesh = Mesh((width, height), self.cells, young_pa=self.young_pa, thickness_m=thickness,
                    density_kg_m3=self.density_kg_m3, steps_per_frame=_CLOTH_STEPS)  # fmt: skip
        rest, boxes = mesh.vertices(), mesh.corners()
        seen = rng.uniform(0.0, 1.0, (_CLOTH_TRACKED, 2))
        motions = [Motion(10 * seed + g, self.stroke_m, 0.0) for g in range(len(boxes))]
        held = [
            np.flatnonzero(np.all((rest >= box[0] - 1e-9) & (rest <= box[1] + 1e-9), axis=1)) for box in boxes
        ]

        def tracks(acting: Acting, late_s: float, at: Floats) -> Floats:
            grips: list[tuple[Any, Place]] = [
                (h, partial(m.place, late_s)) for h, m in zip(held, motions, strict=True)
            ]
            return mesh.record(acting, grips, seen, at)

        def inside(r: np.random.Generator) -> Floats:
            return rest.min(axis=0) + r.uniform(0.0, 1.0, (FILLING, 3)) * [width, 0.0, height] + [
                0.0, 0.5 * thickness, 0.0,
            ] * r.uniform(-1.0, 1.0, (FILLING, 1))  # fmt: skip

        hands = [
            Hand(box, rest[h].mean(axis=0), motion)
            for box, h, motion in zip(boxes, held, motions, strict=True)
        ]
        return Recorder(hands, tracks, inside)


@dataclass(frozen=True)
class Brick:
    """A block of tetrahedra that stands on a table and is drawn over it, one end of it but for its foot in a hand.

    Attributes:
        size_m: length, width and height.
        cells: along the axes.
        young_pa, density_kg_m3: of the material; density is declared.
        friction: of the table, declared.
        stroke_m: how far the hand goes along the axes.
        kind: of the scene.
    """

    size_m: tuple[float, float, float]
    cells: tuple[int, int, int]
    young_pa: float
    density_kg_m3: float
    friction: float
    stroke_m: tuple[float, float, float]
    kind: str = "block"

    @property
    def body(self) -> Body:
        """What the scene declares."""
        return Body(size_m=np.array(self.size_m), density_kg_m3=self.density_kg_m3)

    @property
    def ground(self) -> Ground:
        """The table."""
        return Ground(0.0, self.friction)

    def recorder(self, seed: int, rng: np.random.Generator) -> Recorder:
        """MuJoCo flex; a camera sees places of the surface but for the one that the table hides."""
        from benchmarks.peers.flex_blocks import Block

        block = Block(
            self.size_m, self.cells, self.young_pa, POISSON, self.density_kg_m3, self.friction, _BLOCK_STEPS
        )
        rest = block.vertices()
        low, size = rest.min(axis=0), np.array(self.size_m)
        seen = rng.uniform(0.0, 1.0, (_BLOCK_TRACKED, 3))
        side = rng.integers(0, 3, _BLOCK_TRACKED)
        seen[np.arange(_BLOCK_TRACKED), side] = np.where(side == 2, 1.0, rng.integers(0, 2, _BLOCK_TRACKED))
        motion = Motion(10 * seed, self.stroke_m, 0.0)
        box = low + np.array([[0.0, 0.0, 2 / self.cells[2]], [1 / self.cells[0], 1.0, 1.0]]) * size
        held = np.flatnonzero(np.all((rest >= box[0] - 1e-9) & (rest <= box[1] + 1e-9), axis=1))

        def tracks(acting: Acting, late_s: float, at: Floats) -> Floats:
            return block.record(acting, [(held, partial(motion.place, late_s))], seen, at)

        def inside(r: np.random.Generator) -> Floats:
            return low + r.uniform(0.0, 1.0, (FILLING, 3)) * size

        return Recorder([Hand(box, rest[held].mean(axis=0), motion)], tracks, inside)


_END = (((0.0, 0.0, 0.0), (1.0 / 12, 1.0, 1.0)),)
OBJECTS: dict[str, Object | Cord | Cloth | Brick] = {
    "beam": Object("beam", (0.26, 0.038, 0.036), (12, 2, 2), 7e5, 600.0, _END, 0.03, 0.15),
    "blob": Object("blob", (0.2, 0.1, 0.09), (6, 3, 3), 5e4, 540.0,
                   (((0.0, 1 / 3, 1 / 3), (1 / 6, 2 / 3, 2 / 3)),), 0.02, round=True),
    "finer_blob": Object("blob", (0.2, 0.1, 0.09), (8, 4, 4), 5e4, 540.0,
                         (((0.0, 1 / 4, 1 / 4), (1 / 8, 3 / 4, 3 / 4)),), 0.02, round=True),
    "capped_blob": Object("blob", (0.2, 0.1, 0.09), (8, 4, 4), 5e4, 540.0,
                          (((0.0, 1 / 4, 1 / 4), (1 / 8, 3 / 4, 3 / 4)),), 0.02, round=True, around=True),
    "slab": Object("sheet", (0.22, 0.015, 0.2), (10, 1, 9), 2.6e5, 350.0,
                   (((0.0, 0.0, 8 / 9), (0.1, 1.0, 1.0)), ((0.9, 0.0, 8 / 9), (1.0, 1.0, 1.0))), 0.03),
    "calm_slab": Object("sheet", (0.22, 0.015, 0.2), (10, 1, 9), 2.6e5, 350.0,
                        (((0.0, 0.0, 8 / 9), (0.1, 1.0, 1.0)), ((0.9, 0.0, 8 / 9), (1.0, 1.0, 1.0))),
                        (0.004, 0.03, 0.02)),
    "rope": Cord(0.42, 0.0075, 1e6, 900.0, (0.5, 0.0, -0.86), 0.04, 0.2),
    "cloth": Cloth((0.25, 0.0045, 0.27), (20, 18), 2e5, 370.0, (0.004, 0.03, 0.02)),
    "brick": Brick((0.15, 0.09, 0.075), (9, 6, 5), 4e4, 400.0, 0.45, (0.03, 0.02, 0.0)),
}  # fmt: skip
