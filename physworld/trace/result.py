"""What a trace found: everything that a report or a picture needs."""

from __future__ import annotations

from dataclasses import dataclass, field

from physworld.arrays import Array
from physworld.estimation.noise import Split
from physworld.experiments import Experiment
from physworld.trace.answer import Verdict
from physworld.trace.candidates import Candidate
from physworld.trace.held_out import HeldOut, Outcome
from physworld.trace.hypotheses import Hypothesis
from physworld.trace.search import Step
from physworld.twin.twin import Twin


@dataclass(frozen=True)
class Number:
    """A value with its unit and 95 % interval."""

    value: float
    unit: str
    ci95: tuple[float, float] | None = None


@dataclass(frozen=True)
class Named:
    """An effect in an answer: its name and its numbers."""

    name: str
    parameters: dict[str, Number]


@dataclass(frozen=True)
class Stage:
    """What a stage of a trace has cost: simulations that were not remembered, and the seconds of waiting for them."""

    name: str
    simulations: int
    seconds: float


@dataclass(frozen=True)
class Supported:
    """A set of effects (none: the declared physics), its posterior and what it leaves.

    Attributes:
        effects: names.
        posterior: probability among all sets that were fitted.
        misfit: on the training frames, over the noise.
        left_out: error on left-out blocks, over the noise.
        discrepancy_m: root mean square of that error beyond the noise [m].
    """

    effects: tuple[str, ...]
    posterior: float
    misfit: float
    left_out: float
    discrepancy_m: float


@dataclass(frozen=True)
class TraceResult:
    """See :mod:`physworld.trace.run`.

    Attributes:
        scene: its name.
        verdict: the answer with its models.
        effects, equivalent: what is added, and what would do as well.
        calibrated: the calibrated parameters of the model with the effects.
        declared: the declared physics, refitted.
        split, sigma: frozen split of the first recording; noise [m], or None where it is unknown.
        path: steps of the search.
        candidates, refused: what was tried, and why the rest was not.
        numerics: root mean squared change of the training prediction by each numerical direction, over the noise.
        before, after: open-loop tracks of the first recording, (T, N, 3) [m].
        held_out: errors on the recordings that are held out, if there are any; else on the held-out frames.
        remainder_m, remainder: what is left on the training frames beyond the noise, and in words.
        experiment: what would tell an equivalent set apart, or None.
        simulations, seconds: cost.
        notes: what a reader has to know.
        recordings: every recording of its own, those that are held out last.
        supported: every set of effects with its posterior, the best first.
        shares: the share of the held-out error that each named effect takes away.
        stages: what each has cost, in the order in which they began.
    """

    scene: str
    verdict: Verdict
    effects: tuple[Named, ...]
    equivalent: tuple[tuple[Named, ...], ...]
    calibrated: dict[str, Number]
    declared: Hypothesis
    split: Split
    sigma: float | None
    path: tuple[Step, ...]
    candidates: list[Candidate]
    refused: dict[str, str]
    numerics: dict[str, float]
    before: Array
    after: Array
    held_out: HeldOut
    remainder_m: float
    remainder: str
    simulations: int
    seconds: float
    experiment: Experiment | None = None
    notes: tuple[str, ...] = field(default_factory=tuple)
    recordings: tuple[Outcome, ...] = ()
    stages: tuple[Stage, ...] = ()
    supported: tuple[Supported, ...] = ()
    shares: dict[str, float] = field(default_factory=dict)

    @property
    def better(self) -> Twin | None:
        """The twin with the effects of the verdict, where it adds any."""
        return None if self.verdict.added is None else self.verdict.added.fitted.twin
