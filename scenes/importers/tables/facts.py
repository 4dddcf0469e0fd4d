"""What no recording of markers tells of the body: its kind, its mass, how thick it is. It is asked for by name."""

from __future__ import annotations

from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld_scenes.declaration import KINDS, Kind
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers.options import ImportOptions
from physworld_scenes.importers.tables.guesses import Guess
from physworld_schemas.base import FieldError

DEFAULT_KIND: Kind = "blob"
CHAINS = ("rope", "rod")
NEEDS_RADIUS = ("rope", "rod", "branched_rope")
NEEDS_THICKNESS = ("sheet",)
NEEDS_BOX = ("beam", "block", "blob", "toy")
COVERED_BY = 30
"""Markers that span a volume of their own; fewer need the box of the body."""
CHAIN_SPREAD, CHAIN_SPREAD_MOST = 0.1, 0.3
"""Of the distance between neighbours along a rope, by which the usual one may change, and any."""
MOST_DETOUR = 1.3
"""Of the markers' order over the way from each to the nearest, up to which it is that along the rope."""


def asked_facts(where: str, points: Array, options: ImportOptions) -> tuple[Kind, dict[str, Any], list[str]]:
    """Kind and facts of the body, and what was left open as a warning.

    Raises:
        SceneInvalid: a fact is missing and ``options.assume`` is not set; every one is named with its option.
    """
    facts = dict(options.body)
    missing: list[str] = []
    if options.kind is None:
        missing.append(f"its kind (--kind, one of {', '.join(KINDS)})")
    kind: Kind = options.kind or DEFAULT_KIND
    if options.kind is not None and options.kind not in KINDS:
        raise _invalid(where, f"kind is {options.kind!r}; known are {', '.join(KINDS)}")
    if facts.get("mass_kg") is None and facts.get("density_kg_m3") is None:
        missing.append("its mass or density (--mass KG or --density KG_M3)")
    if options.kind in NEEDS_RADIUS and facts.get("radius_m") is None:
        missing.append(f"the radius of the {kind} (--radius M)")
    if options.kind in NEEDS_THICKNESS and facts.get("thickness_m") is None:
        missing.append(f"the thickness of the {kind} (--thickness M)")
    boxed = facts.get("box_min_m") is not None and facts.get("box_max_m") is not None
    if options.kind in NEEDS_BOX and not boxed and points.shape[1] < COVERED_BY:
        missing.append(
            f"the box of the {kind}, which {points.shape[1]} markers do not span (--box-m X,Y,Z,X,Y,Z, its corners in "
            f"the scene's world [m]; the markers of the first frame lie between {_corner(points[0].min(axis=0))} and "
            f"{_corner(points[0].max(axis=0))})"
        )
    if not missing:
        return kind, facts, []
    said = f"does not say {'; '.join(missing)}"
    if options.assume:
        return kind, facts, [f"left open: {'; '.join(missing)}"]
    raise _invalid(where, f"{said}; or leave that open (--assume)")


def chain_facts(
    kind: Kind, facts: dict[str, Any], points: Array, visible: Array
) -> tuple[dict[str, Any], Guess | None]:
    """The facts of a rope with the rest distances between markers in their order, if these hardly change.

    Args:
        kind, facts: of the body.
        points: (T, N, 3) [m].
        visible: (T, N) bool.
    """
    if kind not in CHAINS or points.shape[1] < 3 or facts.get("segment_rest_lengths_m") is not None:
        return facts, None
    both = visible[:, 1:] & visible[:, :-1]
    apart = np.where(both, np.linalg.norm(np.diff(points, axis=1), axis=2), np.nan)
    if not both.any(axis=0).all():
        return facts, None
    low, middle, high = np.nanquantile(apart, [0.05, 0.5, 0.95], axis=0)
    spreads = (high - low) / np.maximum(middle, 1e-12)
    usual, most = float(np.median(spreads)), float(spreads.max())
    detour = float(middle.sum()) / max(_shortest(points, visible), 1e-12)
    if usual > CHAIN_SPREAD or most > CHAIN_SPREAD_MOST or detour > MOST_DETOUR:
        how = (
            f"not along it: neighbours' distances change by {usual:.0%}, up to {most:.0%}, and sum to {detour:.2g} "
            "times the way from each marker to the nearest; name them in their order"
        )
        return facts, Guess("order", "unknown", how, "markers")
    facts = facts | {"segment_rest_lengths_m": [round(float(length), 6) for length in middle]}
    how = (
        f"neighbours keep their distance within {usual:.1%}, at most {most:.1%}: "
        f"{1e3 * middle.min():.4g} to {1e3 * middle.max():.4g} mm"
    )
    return facts, Guess("order", "along it, as listed", how, "markers")


def _shortest(points: Array, visible: Array) -> float:
    """Length [m] of the way from the first marker to the nearest one, and so on, in the frame that shows most."""
    frame = int(np.argmax(visible.sum(axis=1)))
    left = list(points[frame, visible[frame]])
    here, length = left.pop(0), 0.0
    while left:
        away = np.linalg.norm(np.array(left) - here, axis=1)
        nearest = int(np.argmin(away))
        length += float(away[nearest])
        here = left.pop(nearest)
    return length


def _corner(point: Array) -> str:
    return ",".join(f"{value:.4g}" for value in point)


def _invalid(where: str, message: str) -> SceneInvalid:
    return SceneInvalid([FieldError(loc=[where], msg=message)])
