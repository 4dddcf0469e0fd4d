"""What a scene declares, or plainly shows, about how its body is held and loaded: the rest of the geometry asks here.

*Grips.* A clamp whose markers sit beside the body, not in it, says nothing of the material that it holds. If such
markers never move and the body is a declared box without grips, the body is taken as bonded at the end face that is
nearest to them: a grip of no depth. Controllers that carry a collider are no such markers.

*Load.* ``body.tip_load`` hangs a mass from the body: ``mass_kg``, and ``place_m`` (a point, or the two ends of a
line, in the frame of the box) or a sentence ``where`` that gives some of x, y and z ("x = 0, z = 0.03"); along an axis
that it does not give the load is spread over the body.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.errors import SceneUnsupported
from physworld.scene import Grip, Scene

_STILL_M = 1e-6
_LINE_POINTS = 9
_COORDINATE = re.compile(r"\b([xyz])\s*=\s*(-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?)")


@dataclass(frozen=True)
class Load:
    """A lumped mass [kg] spread evenly over material points of the undeformed body, (M, 3) [m]."""

    mass_kg: float
    points: Array


def grips_of(scene: Scene) -> tuple[Grip, ...]:
    """The declared grips, or the clamp that still markers beside a declared box show."""
    body = scene.body
    pushing = [i for collider in scene.colliders for i in collider.controllers]
    markers = np.setdiff1d(np.arange(scene.controllers.shape[1]), pushing)
    if scene.grips or body.box_min_m is None or body.box_max_m is None or not len(markers):
        return scene.grips
    low, high = np.asarray(body.box_min_m), np.asarray(body.box_max_m)
    first = scene.controllers[0, markers]
    inside = np.all((first >= low) & (first <= high), axis=1)
    if inside.any() or np.ptp(scene.controllers[:, markers], axis=0).max() > _STILL_M:
        return scene.grips
    axis = int(np.argmax(high - low))
    centre = first.mean(axis=0)
    at_low = abs(centre[axis] - low[axis]) <= abs(centre[axis] - high[axis])
    face_low, face_high = low.copy(), high.copy()
    (face_high if at_low else face_low)[axis] = low[axis] if at_low else high[axis]
    return (Grip(tuple(markers.tolist()), face_low, face_high),)


def load_of(scene: Scene) -> Load | None:
    """The declared tip load, or None.

    Raises:
        SceneUnsupported: a load is declared whose mass or place cannot be read.
    """
    facts = (scene.declared.get("body") or {}).get("tip_load")
    if not facts:
        return None
    mass = facts.get("mass_kg")
    if not isinstance(mass, int | float) or not 0 < mass < np.inf:
        raise SceneUnsupported(f"body.tip_load.mass_kg is {mass!r}; a load needs a positive mass")
    place = facts.get("place_m")
    if place is not None:
        ends = np.asarray(place, dtype=float).reshape(-1, 3)
        return Load(float(mass), np.linspace(ends[0], ends[-1], _LINE_POINTS if len(ends) > 1 else 1))
    if scene.body.box_min_m is None or scene.body.box_max_m is None:
        raise SceneUnsupported("body.tip_load without place_m needs body.box_min_m and body.box_max_m")
    given = {
        "xyz".index(axis): float(value) for axis, value in _COORDINATE.findall(str(facts.get("where", "")))
    }
    if not given:
        raise SceneUnsupported(
            f"body.tip_load says no place: neither place_m nor an x, y or z in {facts.get('where')!r}"
        )
    begin, end = np.array(scene.body.box_min_m, dtype=float), np.array(scene.body.box_max_m, dtype=float)
    for axis, value in given.items():
        begin[axis] = end[axis] = value
    corners = [np.linspace(begin[a], end[a], 1 if a in given else _LINE_POINTS) for a in range(3)]
    points = np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1).reshape(-1, 3)
    return Load(float(mass), points)
