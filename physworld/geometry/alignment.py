"""Cells along one axis of a body whose faces lie where its grips end.

What is held and what is free meet at a grip's faces inside the body. A lattice that ignores them holds up to half a
cell too much or too little there, which a wrong modulus then makes up for. Per axis:

- no face inside     cells end at the body's faces
- one face           one cell face there, another at the body's free end; the held end is filled in part
- two or more        cell faces at the two that are farthest apart; both ends are filled in part

``reach`` (in cells) moves a cell face that much into the grip: a held layer of a solid acts beyond its face
(``docs/verification.md``, "The clamp"). Where two faces would need cells much smaller or larger than asked for, the
second is left where it falls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.scene import Grip

_COVERED = 0.9  # a grip that covers this share of an axis holds all of it
_SMALLEST, _LARGEST = 0.6, 1.6  # cells between two faces, in cells that were asked for
_THINNEST_GRIP = 0.25  # cells of gripped material that must stay behind a face that was moved into the grip
_SAME = 1e-6  # share of the body within which two places are one


@dataclass(frozen=True)
class Face:
    """Where a grip ends: its coordinate [m], +1 or -1 from held to free material, the depth of what is held [m]."""

    place: float
    way: int
    depth: float


def faces_along(axis: int, low: Array, high: Array, grips: tuple[Grip, ...]) -> list[Face]:
    """Faces of the grips' regions along an axis of a body from ``low`` to ``high`` (d,), from low to high.

    Args:
        axis: of the body.
        low, high: its corners [m], (d,).
        grips: declared; those without a region have no face.
    """
    body = (float(low[axis]), float(high[axis]))
    slack = _SAME * (body[1] - body[0])
    found: dict[tuple[int, int], Face] = {}
    for grip in grips:
        if grip.region_min_m is None or grip.region_max_m is None:
            continue
        begin, end = float(grip.region_min_m[axis]), float(grip.region_max_m[axis])
        depth = min(end, body[1]) - max(begin, body[0])
        if depth < -slack or depth >= _COVERED * (body[1] - body[0]):
            continue
        depth = max(depth, 0.0)
        if end < body[1] - slack:
            found[round(end / slack), 1] = Face(end, 1, depth)
        if begin > body[0] + slack:
            found[round(begin / slack), -1] = Face(begin, -1, depth)
    return sorted(found.values(), key=lambda face: face.place)


def cells_along(low: float, high: float, cell: float, faces: list[Face], reach: float) -> tuple[float, float]:
    """First cell face [m] at or below ``low``, and the cell size [m], near ``cell``, along one axis.

    Args:
        faces: of the grips, from low to high.
        reach: cells by which a cell face lies inside the grip.
    """
    if not faces:
        return low, (high - low) / max(1, round((high - low) / cell))
    first, last = faces[0], faces[-1]
    if len(faces) > 1 and last.place - first.place > 0.0:
        inwards = [_inwards(face, cell, reach) for face in (first, last)]
        beyond = last.way * inwards[1] - first.way * inwards[0]  # the cell faces are so much closer, in cells
        between = last.place - first.place
        spacing = between / (max(1, round(between / cell - beyond)) + beyond)
        if _SMALLEST * cell <= spacing <= _LARGEST * cell:
            return _before(low, first.place - first.way * inwards[0] * spacing, spacing), spacing
    face = max(faces, key=lambda f: high - f.place if f.way > 0 else f.place - low)  # the longest free part
    inward = _inwards(face, cell, reach)
    free = high - face.place if face.way > 0 else face.place - low
    spacing = free / (max(1, round(free / cell + inward)) - inward)
    return _before(low, face.place - face.way * inward * spacing, spacing), spacing


def _inwards(face: Face, cell: float, reach: float) -> float:
    """Cells by which the cell face lies inside the grip: none where too little held material would stay behind it."""
    bonded = face.depth == 0.0
    return reach if bonded or face.depth > (reach + _THINNEST_GRIP) * cell else 0.0


def _before(low: float, face: float, spacing: float) -> float:
    return face - float(np.ceil((face - low) / spacing - 1e-6)) * spacing
