"""What a recording can show: of every calibrated number its expected interval, of every effect its detectable size.

A *plausible size* of a gate is the deviation of its effect's own prior, where it declares one
(:attr:`physworld.effects.base.Strength.prior_deviation`). Else all is known that its author wrote down: a probe that
just shows in a simulation, and the bound of a search; the size is their geometric mean, the median of a prior that is
even in the logarithm between them. The most that is plausible is twice the deviation, or that bound.

An effect that has shapes (the direction of a tether) is judged by the shape in the middle of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from physworld.arrays import Array
from physworld.check.information import Information
from physworld.check.physics import Physics
from physworld.effects.base import Strength
from physworld.effects.registry import EFFECTS
from physworld.estimation.unknowns import Unknown
from physworld.trace.candidates import Candidate
from physworld.trace.sensitivity import Response

VISIBLE, LARGE, INVISIBLE = "visible", "only_if_large", "invisible"
ALIKE = 0.95  # correlation from which a pair is told of, as in a trace
_Z95 = 1.96


@dataclass(frozen=True)
class Asked:
    """Gates of an effect that are asked together, in all shapes.

    Attributes:
        effect: name in the registry.
        label: for reports: the effect, and which gates where they are not all of it.
        gates: its strengths, k of them.
        variants: one a shape.
        shapes: columns (k,) of every shape in the information.
    """

    effect: str
    label: str
    gates: tuple[Strength, ...]
    variants: tuple[Candidate, ...]
    shapes: tuple[Array, ...]

    @property
    def names(self) -> set[str]:
        """Of its gates, as unknowns have them."""
        return {f"{self.effect}.{gate.name}" for gate in self.gates}


@dataclass(frozen=True)
class ParameterFigure:
    """A calibrated number.

    Attributes:
        name, unit: of it.
        value: at which the check was made.
        prior95, expected95: 95 % intervals before and after a calibration, in ``unit``.
        ratio: width of the second over the first's, in the scale of the search.
        optional: a calibration frees it only where data ask for it.
        given: its value was given by the caller.
    """

    name: str
    unit: str
    value: float
    prior95: tuple[float, float]
    expected95: tuple[float, float]
    ratio: float
    optional: bool
    given: bool


@dataclass(frozen=True)
class GateFigure:
    """A strength of an effect, in ``unit``: a plausible size, the most that is plausible, and what would be detected.

    ``detectable`` is that of the gate alone, with the effect's other gates free; infinite where nothing is.
    """

    name: str
    unit: str
    plausible: float
    most: float
    detectable: float


@dataclass(frozen=True)
class EffectFigure:
    """An effect.

    Attributes:
        effect, label, title: name in the registry; that with its gates where these are not all; for people.
        status: VISIBLE, LARGE or INVISIBLE.
        multiple: of its plausible size that would be detected; infinite where it does nothing that shows.
        gates: its strengths.
        shapes, visible_shapes: how many shapes were asked, and in how many it is visible.
        hidden_by: calibrated numbers, if any one of which were known it would be visible, and how it correlates with
            each beyond the others.
    """

    effect: str
    label: str
    title: str
    status: str
    multiple: float
    gates: tuple[GateFigure, ...]
    shapes: int
    visible_shapes: int
    hidden_by: Mapping[str, float]


@dataclass(frozen=True)
class Pair:
    """Two effects that look alike: by their correlation, or because they are taken for each other at plausible sizes.

    Attributes:
        labels: of both.
        correlation: of what they do beyond the calibrated numbers; of the less alike direction.
        apart_from: multiple of the plausible size from which they are told apart, of the easier direction.
    """

    labels: tuple[str, str]
    correlation: float
    apart_from: float

    @property
    def taken_for_each_other(self) -> bool:
        """At plausible sizes."""
        return self.apart_from > 1.0


@dataclass(frozen=True)
class View:
    """The answer under one assumption of how far the twin is off.

    Attributes:
        discrepancy_m: deviation per axis of the model's own error [m].
        share: of the motion's extent.
        parameters, effects: figures, in the order of the calibration and of the registry.
        pairs: effects that look alike.
        groups: labels of effects that are not told apart at their plausible sizes, as they hang together by pairs.
    """

    discrepancy_m: float
    share: float
    parameters: tuple[ParameterFigure, ...]
    effects: tuple[EffectFigure, ...]
    pairs: tuple[Pair, ...]
    groups: tuple[tuple[str, ...], ...]

    def effect(self, label: str) -> EffectFigure:
        """The effect of that label. Raises KeyError."""
        return {figure.label: figure for figure in self.effects}[label]

    def parameter(self, name: str) -> ParameterFigure:
        """The number of that name. Raises KeyError."""
        return {figure.name: figure for figure in self.parameters}[name]


def plausible(gate: Strength) -> tuple[float, float]:
    """A plausible size of a gate, and the most that is plausible, in its unit."""
    if gate.prior_deviation is not None:
        return gate.prior_deviation, 2.0 * gate.prior_deviation
    most = max(abs(gate.low), abs(gate.high))
    return float(np.sqrt(gate.probe * most)), most


def scaled(
    unknowns: Sequence[Unknown], slopes: Array, responses: Sequence[Response]
) -> tuple[Array, list[Asked]]:
    """Columns (M, q) in deviations of their priors, first the numbers' then the effects', and where these lie.

    Args:
        unknowns: with priors, p of them.
        slopes: whitened sensitivities to them, (M, p), per unit of their search.
        responses: usable ones of the effects' variants.
    """
    columns = [slopes * deviations(unknowns)]
    found: dict[tuple[str, tuple[str, ...]], list[tuple[Candidate, Array]]] = {}
    place = slopes.shape[1]
    for response in responses:
        candidate = response.candidate
        columns.append(in_sizes(response))
        own = np.arange(place, place + len(candidate.gates))
        key = (candidate.effect, tuple(gate.name for gate in candidate.gates))
        found.setdefault(key, []).append((candidate, own))
        place += len(own)
    parts = [effect for effect, _ in found]
    asked = []
    for (effect, names), shapes in found.items():
        label = effect if parts.count(effect) == 1 else f"{effect}.{names[0]}"
        variants, places = zip(*shapes, strict=True)
        asked.append(Asked(effect, label, variants[0].gates, variants, places))
    return np.concatenate(columns, axis=1), asked


def deviations(unknowns: Sequence[Unknown]) -> Array:
    """Of the numbers' priors, in the scale of the search, (p,)."""
    return np.array([unknown.prior[1] for unknown in unknowns if unknown.prior is not None])


def in_sizes(response: Response) -> Array:
    """Whitened sensitivities (M, k) per plausible size of every gate."""
    gates = response.candidate.gates
    columns: Array = response.columns * np.array([plausible(gate)[0] / gate.probe for gate in gates])
    return columns


class Judge:
    """Figures of one recording, or of several, from their information."""

    def __init__(self, physics: Physics, asked: Sequence[Asked]) -> None:
        self.physics, self.asked = physics, list(asked)
        names = [unknown.name for unknown in physics.probed]
        self._numbers = np.arange(len(names))
        self._always = np.array([name not in physics.optional for name in names], dtype=bool)

    def calibrated(self, *effects: Asked) -> Array:
        """Columns that a trace calibrates beside these effects, (p,)."""
        taken = set[str]().union(*(one.names for one in effects))
        own = np.array([u.name not in taken for u in self.physics.probed], dtype=bool)
        found: Array = self._numbers[self._always & own]
        return found

    def view(self, information: Information, discrepancy_m: float, share: float) -> View:
        """The whole answer."""
        effects = [self.figure(information, one) for one in self.asked]
        shown = [
            (one, self.middle(information, one))
            for one, figure in zip(self.asked, effects, strict=True)
            if figure.status != INVISIBLE
        ]
        pairs = [
            self.pair(information, a, b) for a, b in combinations(shown, 2) if a[0].effect != b[0].effect
        ]
        alike = tuple(pair for pair in pairs if pair.correlation >= ALIKE or pair.taken_for_each_other)
        groups = _groups([pair for pair in alike if pair.taken_for_each_other])
        return View(discrepancy_m, share, self._parameters(information), tuple(effects), alike, groups)

    def _parameters(self, information: Information) -> tuple[ParameterFigure, ...]:
        ratios = information.deviations(self._numbers)
        widest: dict[str, float] = {}  # of a number that is varied both ways
        for unknown, ratio in zip(self.physics.probed, ratios, strict=True):
            widest[unknown.name] = max(widest.get(unknown.name, 0.0), float(ratio))
        return tuple(self._parameter(unknown, widest[unknown.name]) for unknown in self.physics.unknowns)

    def _parameter(self, unknown: Unknown, ratio: float) -> ParameterFigure:
        assert unknown.prior is not None
        mean, deviation = unknown.prior
        return ParameterFigure(
            unknown.name,
            unknown.unit,
            unknown.value(unknown.start),
            _interval(unknown, mean, _Z95 * deviation),
            _interval(unknown, unknown.start, _Z95 * deviation * ratio),
            ratio,
            unknown.name in self.physics.optional,
            unknown.name in self.physics.given,
        )

    def middle(self, information: Information, asked: Asked) -> Asked:
        """The effect in the shape alone by which it is judged."""
        if len(asked.shapes) == 1:
            return asked
        calibrated = self.calibrated(asked)
        place = _middle([information.detectable(shape, calibrated)[0] for shape in asked.shapes])
        return replace(asked, variants=(asked.variants[place],), shapes=(asked.shapes[place],))

    def figure(self, information: Information, asked: Asked) -> EffectFigure:
        """An effect by the shape in the middle of its shapes."""
        calibrated = self.calibrated(asked)
        found = [information.detectable(shape, calibrated) for shape in asked.shapes]
        middle = _middle([multiple for multiple, _ in found])
        multiple, alone = found[middle]
        sizes = [plausible(gate) for gate in asked.gates]
        furthest = min(most / size for size, most in sizes)
        gates = tuple(
            GateFigure(gate.name, gate.unit, size, most, float(one * size))
            for gate, (size, most), one in zip(asked.gates, sizes, alone, strict=True)
        )
        return EffectFigure(
            asked.effect,
            asked.label,
            EFFECTS[asked.effect].title,
            VISIBLE if multiple <= 1.0 else LARGE if multiple <= furthest else INVISIBLE,
            multiple,
            gates,
            len(found),
            sum(one <= 1.0 for one, _ in found),
            {} if multiple <= 1.0 else self._hiding(information, asked.shapes[middle], calibrated),
        )

    def _hiding(self, information: Information, shape: Array, calibrated: Array) -> dict[str, float]:
        found = {}
        names = np.array([unknown.name for unknown in self.physics.probed])
        for name in dict.fromkeys(names[calibrated]):
            own, others = calibrated[names[calibrated] == name], calibrated[names[calibrated] != name]
            if information.detectable(shape, others)[0] <= 1.0:
                found[str(name)] = information.apart(shape, own, others)[0]
        return found

    def pair(self, information: Information, first: tuple[Asked, Asked], second: tuple[Asked, Asked]) -> Pair:
        """How alike two effects look.

        Args:
            information: of the recording.
            first, second: the effects, in all shapes and in the middle one.
        """
        calibrated = self.calibrated(first[0], second[0])
        ways = []
        for (_, acts), (other, _) in ((first, second), (second, first)):
            every = [information.apart(acts.shapes[0], shape, calibrated) for shape in other.shapes]
            ways.append(max(every, key=lambda way: way[0]))  # the shape that imitates it best
        correlation, apart = (min(way[k] for way in ways) for k in range(2))
        return Pair((first[0].label, second[0].label), correlation, apart)


def _interval(unknown: Unknown, middle: float, half: float) -> tuple[float, float]:
    low, high = unknown.bounds
    return unknown.value(max(low, middle - half)), unknown.value(min(high, middle + half))


def _middle(multiples: Sequence[float]) -> int:
    """Place of the median; of an even count the worse of the two."""
    return int(np.argsort(multiples, kind="stable")[len(multiples) // 2])


def _groups(pairs: Sequence[Pair]) -> tuple[tuple[str, ...], ...]:
    labels = list(dict.fromkeys(label for pair in pairs for label in pair.labels))
    if not labels:
        return ()
    rows, columns = ([labels.index(pair.labels[k]) for pair in pairs] for k in range(2))
    graph = coo_array((np.ones(len(pairs)), (rows, columns)), shape=(len(labels), len(labels)))
    count, group = connected_components(graph, directed=False)
    return tuple(
        tuple(label for label, own in zip(labels, group, strict=True) if own == k) for k in range(count)
    )
