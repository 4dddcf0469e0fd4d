"""A ground that is not as declared: rougher or smoother, higher or lower.

    mu' = max(0, mu + d)        height' = height + h

Coulomb's law is the contact's own; the effect changes its two numbers and costs no kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from physworld.effects.base import Effect, Strength, Variant, one_by_one
from physworld.effects.places import body_size
from physworld.engine.problem import Problem
from physworld.engine.terms.contact import GroundContact

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class GroundFriction(Effect):
    """``change``: d, added to the coefficient of friction; ``height_m``: h."""

    name = "ground_friction"
    title = "other friction or height of the ground"
    equation = "mu' = max(0, mu + d), height' = height + h"
    kind = "boundary"
    gates = ("change", "height_m")

    change: float = 0.0
    height_m: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """From ice to rubber; the height by a tenth of the body."""
        reach = 0.1 * body_size(twin)
        return (
            Strength("change", "1", -twin.ground_friction, 1.5, 0.05),
            Strength("height_m", "m", -reach, reach, 0.01 * reach),
        )

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """Friction and height apart."""
        return one_by_one(cls.strengths(twin), ("change",), ("height_m",))

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """A twin that touches no ground."""
        return no_ground(twin)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Changes the contact's numbers."""
        terms = [
            replace(t, friction=max(0.0, t.friction + self.change), height_m=t.height_m + self.height_m)
            if isinstance(t, GroundContact)
            else t
            for t in problem.terms
        ]
        return replace(problem, terms=tuple(terms))


def no_ground(twin: Twin) -> str | None:
    """Why nothing of the ground can act on this twin, or None."""
    if any(isinstance(contact, GroundContact) for contact in twin.contacts):
        return None
    return f"the body touches no ground ({len(twin.contacts)} contacts; ground height {twin.ground_height_m})"
