"""What an effect is: a named departure from the declared physics, with strengths that a trace may estimate.

An effect is a frozen dataclass. Its *gates* are the strengths whose zero means that nothing is there; with every gate
at zero :attr:`Effect.active` is false, no hook is called, and the simulation is the same to the last bit. Other
strengths (a relaxation time, a place) only shape what an open gate lets in; ``None`` lets the effect choose a place
from the twin.

The hooks run in this order: :meth:`~Effect.controls`, :meth:`~Effect.problem`, :meth:`~Effect.grips`,
:meth:`~Effect.attach`, then the integration, then :meth:`~Effect.followed` and :meth:`~Effect.measured`; in each the
effects take their turn in the order of the registry. A hook leaves what it does not change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal

from physworld.arrays import Array
from physworld.engine.problem import HeldNodes, Problem

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

Kind = Literal["force", "stress", "boundary", "field", "measurement"]
Shape = dict[str, float]
"""Numbers that only shape an effect (a direction, a place, a time), by name."""
Mirror = Callable[[Shape], Shape]


@dataclass(frozen=True)
class Strength:
    """One number of an effect.

    Attributes:
        name: the effect's field.
        unit: SI unit; "1" for none.
        low, high: bounds of a search.
        probe: a step for sensitivities, large enough to show in a simulation and small enough to stay linear.
        gate: zero switches the effect off; False for a number that only shapes it.
        start: where a search starts: 0 of a gate, else the field's default or the place that ``None`` chooses.
        prior_deviation: standard deviation about 0 of what is known before any recording, in ``unit``; None: nothing.
    """

    name: str
    unit: str
    low: float
    high: float
    probe: float
    gate: bool = True
    start: float = 0.0
    prior_deviation: float | None = None


@dataclass(frozen=True)
class Calibrated:
    """A strength that is calibrated whatever acts: how a grip holds, which no lattice knows.

    Attributes:
        strength: with the range in which it is no effect of its own.
        step: of finite differences, in its unit.
        spread: deviation about zero of what is known beforehand.
        start: where a search begins.
    """

    strength: Strength
    step: float
    spread: float
    start: float = 0.0


@dataclass(frozen=True)
class Variant:
    """One form in which a trace tries an effect: a linear score is taken of its gates, with its shape fixed.

    Attributes:
        gates: names of the strengths that are free from the start.
        label: what tells it from the effect's other variants.
        fixed: values of the strengths that only shape the effect.
        shapes: names of those of them that a refit of the best variant frees.
    """

    gates: tuple[str, ...]
    label: str = ""
    fixed: Shape = field(default_factory=dict)
    shapes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Effect:
    """Base of the effects; see the module's text.

    Attributes:
        name: name in the registry.
        title: a few words for people.
        equation: the law in plain text.
        kind: where it enters.
        gates: fields whose zero switches the effect off.
        strains: acts on the strains of a body's cells, which a mesh of triangles does not have.
        odds: that it acts, before any recording, over those of other effects; below one where hardly any body has it.
        contains: effects that this one is, with some of its strengths at zero; its others have to earn their place
            beside them.
        instead: a measurement that settles whether the effect is there without a motion of the grips, for people.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    equation: ClassVar[str]
    kind: ClassVar[Kind]
    gates: ClassVar[tuple[str, ...]]
    strains: ClassVar[bool] = False
    odds: ClassVar[float] = 1.0
    contains: ClassVar[tuple[str, ...]] = ()
    instead: ClassVar[str | None] = None

    @property
    def active(self) -> bool:
        """Whether any gate is open."""
        return any(getattr(self, gate) != 0.0 for gate in self.gates)

    @property
    def values(self) -> dict[str, float | None]:
        """Every field by name: what :func:`physworld.effects.registry.effect` takes to make it again."""
        return asdict(self)

    def derived(self, twin: Twin) -> dict[str, tuple[float, str]]:
        """Numbers that people ask for and the strengths imply on this twin: name to (value, unit)."""
        return {}

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """What a trace may estimate on this twin; bounds and probes follow its scales."""
        raise NotImplementedError(f"{cls.__name__} names no strengths")

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """The forms in which a trace tries the effect on this twin: by default one, with every gate free."""
        return [Variant(tuple(s.name for s in cls.strengths(twin) if s.gate))]

    @classmethod
    def calibrated(cls, twin: Twin) -> Calibrated | None:
        """A strength that every fit of this twin has within a range, whatever acts; by default none."""
        return None

    @classmethod
    def mirror(cls, twin: Twin) -> Mirror | None:
        """From a shape to another one that to first order does the same; None where there is none."""
        return None

    def implausible(self) -> str | None:
        """Why nobody would believe these strengths, whatever a recording says; None where one may."""
        return None

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """Why the effect makes no sense for this twin; None where it does."""
        return None

    @classmethod
    def why_not(cls, twin: Twin) -> str | None:
        """Why a twin cannot have the effect: it makes no sense there, or its engine cannot do it; None if it can."""
        if cls.strains and not twin.lattice.smooth:
            return f"it acts on strains of splines; {twin.lattice.title} has none"
        return cls.refuses(twin)

    def placed(self, twin: Twin) -> Effect:
        """The same with the places that ``None`` leaves to the twin."""
        return self

    def controls(self, times: Array, points: Array) -> tuple[Array, Array]:
        """The control track (Tc,) [s], (Tc, K, 3) [m] that the body really followed."""
        return times, points

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """The problem with its fields, its gravity or its terms changed."""
        return problem

    def grips(self, twin: Twin) -> Twin:
        """The twin whose grips prescribe the motion: other nodes held, or held from another start."""
        return twin

    def attach(self, problem: Problem, held: HeldNodes, twin: Twin) -> tuple[Problem, HeldNodes]:
        """For a grip that pulls instead of prescribing: takes nodes out of ``held`` and adds a term."""
        return problem, held

    def followed(self, twin: Twin) -> Twin:
        """The twin whose tracked points are followed: other ones where the first frame shows them wrongly."""
        return twin

    def measured(self, times: Array, tracks: Array, twin: Twin) -> Array:
        """What the camera reports at ``times`` (T,) [s] of true ``tracks`` (T, N, 3) [m]."""
        return tracks


def one_by_one(strengths: tuple[Strength, ...], *groups: tuple[str, ...]) -> list[Variant]:
    """One variant a group of gates, of those that a twin has; a group's label is its first gate's name."""
    known = {s.name for s in strengths}
    present = [tuple(gate for gate in group if gate in known) for group in groups]
    return [Variant(group, group[0]) for group in present if group]
