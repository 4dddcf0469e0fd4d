"""Candidates of a trace: every effect of the registry that makes sense for the twin, in the variants that are tried.

A variant fixes the numbers that only shape an effect (a direction, a place, a time) and leaves its gates free, so that
one simulation per gate shows what it does. Where one shape does not stand for all, an effect has several variants; a
refit then frees the shape of the best.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from physworld.effects.base import Mirror, Shape, Strength
from physworld.effects.registry import EFFECTS
from physworld.estimation.unknowns import Unknown
from physworld.trace.unknowns import of_strength, with_strengths
from physworld.twin.twin import Twin

_SHAPE_STEP = 0.01  # difference step of a shape, of its range


@dataclass(frozen=True)
class Candidate:
    """A variant of an effect.

    Attributes:
        effect: name in the registry.
        variant: what tells it from others of the same effect.
        gates: strengths that are free from the start.
        fixed: shapes, as the variant has them.
        shapes: which of them a refit frees.
        kind: where the effect enters.
        mirror: from a shape to another one that to first order does the same; None where there is none.
    """

    effect: str
    variant: str
    gates: tuple[Strength, ...]
    fixed: Shape = field(default_factory=dict)
    shapes: tuple[Strength, ...] = ()
    kind: str = "force"
    mirror: Mirror | None = None

    @property
    def label(self) -> str:
        """For reports."""
        return self.effect if not self.variant else f"{self.effect} ({self.variant})"

    @property
    def contains(self) -> tuple[str, ...]:
        """Effects that it is with some strengths at zero."""
        return EFFECTS[self.effect].contains

    @property
    def odds(self) -> float:
        """That the effect acts, over those of other effects."""
        return EFFECTS[self.effect].odds

    def unknowns(self) -> list[Unknown]:
        """The gates, in units of their probes; with what is known of them beforehand."""
        return [of_strength(self.effect, gate, spread=gate.prior_deviation) for gate in self.gates]

    def shape_unknowns(self) -> list[Unknown]:
        """The shapes that a refit frees, from where the variant has them."""
        return [
            of_strength(self.effect, s, _SHAPE_STEP * (s.high - s.low), self.fixed[s.name])
            for s in self.shapes
        ]

    def prepared(self, twin: Twin) -> Twin:
        """The twin with the variant's shapes and closed gates."""
        return with_strengths(twin, self.effect, self.fixed) if self.fixed else twin


def candidates(twin: Twin, names: tuple[str, ...] = ()) -> tuple[list[Candidate], dict[str, str]]:
    """Every variant of the named effects (all by default), and why the other effects were refused."""
    found: list[Candidate] = []
    refused: dict[str, str] = {}
    for name, effect in EFFECTS.items():
        if names and name not in names:
            continue
        reason = effect.why_not(twin)
        if reason is not None:
            refused[name] = reason
            continue
        known = {s.name: s for s in effect.strengths(twin)}
        mirror = effect.mirror(twin)
        for variant in effect.variants(twin):
            gates = tuple(known[gate] for gate in variant.gates)
            shapes = tuple(known[shape] for shape in variant.shapes)
            found.append(Candidate(name, variant.label, gates, variant.fixed, shapes, effect.kind, mirror))
    return found, refused
