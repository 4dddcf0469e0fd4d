"""One effect that is the sum of two others: a wind is a drag in still air and a push, and a tilt of gravity pushes too.

    a = p - c v        p across gravity: a wind p / c, or a drag c where gravity is tilted by about |p| / g

No recording of one place tells the two apart, so where a wind does, the pair is asked as well. Where the push is not
across gravity the pair fits worse, for gravity's strength is known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from physworld.effects.gravity_tilt import horizontal_axes
from physworld.trace.candidates import Candidate
from physworld.trace.confirm import Confirmation, Model

WHOLE = "wind"
PARTS = ("air_drag_linear", "gravity_tilt")


def is_in_parts(model: Model) -> bool:
    """Whether a model's effects are the parts of one."""
    return set(model.names) == set(PARTS)


def count_of_effects(model: Model) -> int:
    """Effects in a model; the parts of one count as that one."""
    return 1 if is_in_parts(model) else len(model.members)


def other_names(model: Model, other: Model) -> bool:
    """Whether one is the sum and the other its parts."""
    return sorted([sorted(model.names), sorted(other.names)]) == sorted([[WHOLE], sorted(PARTS)])


def in_parts(
    confirmation: Confirmation, base: Model, whole: Model, candidates: Sequence[Candidate]
) -> Model | None:
    """The parts of a wind, refitted from its numbers; None where one is no candidate, or no run was usable."""
    tilts = ("tilt_x_rad", "tilt_y_rad")
    gates = {PARTS[0]: ("rate_per_s",), PARTS[1]: tilts}
    members = tuple(
        next(
            (c for c in candidates if c.effect == part and tuple(g.name for g in c.gates) == gates[part]),
            None,
        )
        for part in PARTS
    )
    known = [member for member in members if member is not None]
    if base.members or len(known) < len(PARTS):
        return None
    gravity = np.asarray(base.fitted.twin.gravity_m_s2, dtype=float)
    push = np.array([whole.fitted.value(f"{WHOLE}.push_{axis}_m_s2") for axis in "xyz"])
    angles = [
        float(push @ np.cross(axis, gravity)) / float(gravity @ gravity) for axis in horizontal_axes(gravity)
    ]
    strengths = [whole.fitted.value(f"{WHOLE}.rate_per_s"), *angles]
    return confirmation.together(base, tuple(known), strengths, whole)
