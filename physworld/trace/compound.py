"""An effect that is the sum of others: a wind is a drag in still air and a push, and a tilt of gravity pushes too.

    a = p - c v        p across gravity: a wind p / c, or a drag c where gravity is tilted by about |p| / g

No recording of one place tells the two apart, so where the sum does, its parts are asked as well. Where the push is not
across gravity the pair fits worse, for gravity's strength is known. Which effect is a sum of which says the effect
itself (:attr:`physworld.effects.base.Effect.parts`).
"""

from __future__ import annotations

from collections.abc import Sequence

from physworld.effects.registry import EFFECTS, effect
from physworld.trace.candidates import Candidate
from physworld.trace.confirm import Confirmation, Model


def whole_of(model: Model) -> str | None:
    """The effect whose parts a model's effects are; None where they are of none."""
    own = set(model.names)
    return next((name for name, kind in EFFECTS.items() if kind.parts and set(kind.parts) == own), None)


def has_parts(model: Model) -> bool:
    """Whether a model is one effect that is the sum of others."""
    return len(model.names) == 1 and model.names[0] in EFFECTS and bool(EFFECTS[model.names[0]].parts)


def count_of_effects(model: Model) -> int:
    """Effects in a model; the parts of one count as that one."""
    return 1 if whole_of(model) is not None else len(model.members)


def other_names(model: Model, other: Model) -> bool:
    """Whether one is the sum and the other its parts."""
    return model.names == (whole_of(other),) or other.names == (whole_of(model),)


def in_parts(
    confirmation: Confirmation, base: Model, whole: Model, candidates: Sequence[Candidate]
) -> Model | None:
    """The parts of a sum, refitted from its numbers; None where one is no candidate, or no run was usable.

    Args:
        confirmation: refits of the trace.
        base: the declared physics.
        whole: the model of one effect that is a sum (:func:`has_parts`).
        candidates: variants that may be parts.
    """
    name = whole.names[0]
    kind = EFFECTS[name]
    members = tuple(
        next(
            (c for c in candidates if c.effect == part and tuple(g.name for g in c.gates) == gates),
            None,
        )
        for part, gates in kind.parts.items()
    )
    known = [member for member in members if member is not None]
    if base.members or len(known) < len(kind.parts):
        return None
    found = effect(name, **{gate: whole.fitted.value(f"{name}.{gate}") for gate in kind.gates})
    return confirmation.together(base, tuple(known), found.in_parts(base.fitted.twin), whole)
