"""A further motion that shows what a recording does not: the best of a trace's library of motions.

Every motion is simulated with the declared physics and with a step of every calibrated number and of every effect in
question: those that the recording misses least, for what it misses by far no motion shows. What it says is added to
what the recording says, for both are of one object; the motion that makes the most effects visible, or tells the most
pairs apart, is proposed. Motions keep the limits that the recording itself has shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.check.information import Information
from physworld.check.recorded import Recorded, recorded
from physworld.check.visibility import VISIBLE, Asked, Judge, View, deviations, in_sizes
from physworld.effects.registry import EFFECTS
from physworld.errors import SimulationError
from physworld.estimation.refit import sensitivities
from physworld.estimation.simulations import Drive, Simulations
from physworld.experiments.search import Library, from_rest, library_of
from physworld.scene import Scene
from physworld.trace.sensitivity import candidate_responses

STAGE = "motions"
MOST_GATES = 10  # of effects in question


@dataclass(frozen=True)
class Change:
    """What a motion does for an effect or for a pair of them: multiples of the plausible sizes before and after."""

    labels: tuple[str, ...]
    before: float
    after: float

    @property
    def shown(self) -> bool:
        """Whether the motion makes the difference."""
        return self.before > 1.0 >= self.after


@dataclass(frozen=True)
class Proposal:
    """A further motion.

    Attributes:
        description: in words.
        motion: family; None where no motion shows more.
        times_s, controllers: control points, (S,) from 0 and (S, K, 3) [m]; empty without a motion.
        frame_times_s: at which it is to be filmed, (T,).
        shows: effects that are not visible now.
        separates: pairs that are taken for each other now.
        tried: motions.
        instead: what else would settle what stays open.
    """

    description: str
    motion: str | None
    times_s: Array
    controllers: Array
    frame_times_s: Array
    shows: tuple[Change, ...]
    separates: tuple[Change, ...]
    tried: int
    instead: tuple[str, ...]


@dataclass(frozen=True)
class Limits:
    """Of the search: motions that are drawn, simulations at most, the longest motion [s], and the seed."""

    draws: int
    simulations: int
    longest_s: float
    seed: int


class MotionSearch:
    """Of one check.

    Args:
        simulations: of the recording, whose runner, memory and count are used on.
        scene: the recording.
        judge: of its parameters and effects.
        known: what the recording says.
        view: its answer, under the same assumption.
        sigma: noise [m].
        limits: of the search.
    """

    def __init__(
        self,
        simulations: Simulations,
        scene: Scene,
        judge: Judge,
        known: Information,
        view: View,
        sigma: float,
        limits: Limits,
    ) -> None:
        self._simulations, self.scene, self.judge, self.known = simulations, scene, judge, known
        self.view, self.sigma, self.limits = view, sigma, limits
        asked = {one.label: one for one in judge.asked}
        alike = [pair for pair in view.pairs if pair.taken_for_each_other]
        hidden = sorted((f for f in view.effects if f.status != VISIBLE), key=lambda f: f.multiple)
        wanted = [label for pair in alike for label in pair.labels] + [figure.label for figure in hidden]
        gates = np.cumsum([len(asked[label].gates) for label in dict.fromkeys(wanted)])
        labels = list(dict.fromkeys(wanted))[: max(int(np.sum(gates <= MOST_GATES)), 1)]
        self.targets = [judge.middle(known, asked[label]) for label in labels]
        own = {one.label: one for one in self.targets}
        self.hidden = [own[figure.label] for figure in hidden if figure.label in own]
        self.pairs = [(own[a], own[b]) for a, b in (pair.labels for pair in alike) if a in own and b in own]

    def proposal(self) -> Proposal | None:
        """The best motion; None where everything is visible and told apart, or nothing can be moved."""
        twin = self.judge.physics.twin
        if not self.targets or not twin.controller_groups or not any(len(nodes) for nodes in twin.held_nodes):
            return None
        library = library_of(self.scene, twin, self.limits.draws, self.limits.longest_s, self.limits.seed)
        begun, tried = self._simulations.count, 0
        best: tuple[tuple[int, float], int, list[Change], list[Change]] | None = None
        for number in range(len(library.motions)):
            if tried and (self._simulations.count - begun) * (tried + 1) > tried * self.limits.simulations:
                break
            tried += 1
            said = self._said_by(library, number)
            if said is None:
                continue
            shows, separates = self._changes(self.known + said)
            every = [*shows, *separates]
            score = sum(c.shown for c in every), sum(_gain(c) for c in every)
            if best is None or score > best[0]:
                best = score, number, shows, separates
        return self._told(library, tried, best)

    def _said_by(self, library: Library, number: int) -> Information | None:
        """What a recording of a motion would say; None where its run cannot be trusted."""
        physics = self.judge.physics
        unknowns, twin = list(physics.probed), from_rest(physics.twin)
        points = library.motions[number][1].points
        there = self._simulations.elsewhere(Drive(library.control_times, points, library.frame_times))
        there.stage = STAGE
        frames = len(library.frame_times)
        filmed = replace(
            self.scene,
            points=np.repeat(self.scene.points[:1], frames, axis=0),
            visible=np.repeat(self.scene.visible[:1], frames, axis=0),
            times=library.frame_times,
            controllers=points[:: (len(points) - 1) // (frames - 1)],
            train=(0, frames),
            test=(frames, frames),
        )
        try:
            made: Recorded = recorded(there, filmed, twin, self.sigma, self.view.share)
        except SimulationError:
            return None
        finally:
            self._simulations.count = there.count
        slopes, failed = sensitivities(there, made.white, twin, made.tracks, unknowns, frames)
        variants = [one.variants[0] for one in self.targets]
        responses = candidate_responses(there, made.white, twin, made.tracks, variants, frames)
        self._simulations.count = there.count
        columns = np.zeros((len(slopes), len(self.known.matrix)))
        columns[:, : len(unknowns)] = slopes * deviations(unknowns)
        for one, response in zip(self.targets, responses, strict=True):
            columns[:, one.shapes[0]] = in_sizes(response)
        if any(failed) or any(response.failed for response in responses):
            return None
        return Information.of(columns, made.discrepancy, made.kappa, self.known.library)

    def _changes(self, both: Information) -> tuple[list[Change], list[Change]]:
        before = {figure.label: figure.multiple for figure in self.view.effects}
        apart = {pair.labels: pair.apart_from for pair in self.view.pairs}
        shows = [
            Change((one.label,), before[one.label], self.judge.figure(both, one).multiple)
            for one in self.hidden
        ]
        separates = []
        for a, b in self.pairs:
            pair = self.judge.pair(both, (a, a), (b, b))
            separates.append(Change(pair.labels, apart[pair.labels], pair.apart_from))
        return shows, separates

    def _told(
        self,
        library: Library,
        tried: int,
        best: tuple[tuple[int, float], int, list[Change], list[Change]] | None,
    ) -> Proposal:
        if best is None or best[0][0] == 0:
            instead = _instead(self.targets)
            words = f"None of {tried} motions within this recording's reach and speed shows more"
            words += f". Instead: {'; '.join(instead)}." if instead else "."
            shows, separates = ((), ()) if best is None else (tuple(best[2]), tuple(best[3]))
            none = np.empty(0)
            return Proposal(words, None, none, np.empty((0, 0, 3)), none, shows, separates, tried, instead)
        _, number, shown, separated = best
        family, motion = library.motions[number]
        new = [change.labels[0] for change in shown if change.shown]
        parted = [" from ".join(change.labels) for change in separated if change.shown]
        does = [f"shows {', '.join(new)}"] if new else []
        does += [f"tells {', '.join(parted)}"] if parted else []
        left = [one for one in self.targets if one.label not in new]
        rate = 1.0 / (library.frame_times[1] - library.frame_times[0])
        words = (
            f"{motion.words[0].upper()}{motion.words[1:]}; film {library.frame_times[-1]:.2g} s at {rate:.4g} frames "
            f"per second. With the recording at hand this {' and '.join(does)}."
        )
        return Proposal(
            words, family, library.control_times, motion.points, library.frame_times, tuple(shown), tuple(separated),
            tried, _instead(left),
        )  # fmt: skip


def _gain(change: Change) -> float:
    """How much nearer to the plausible size, in logarithms; what lies below that counts for nothing more."""
    before, after = (np.log(np.clip(size, 1.0, 1e6)) for size in (change.before, change.after))
    return float(before - after)


def _instead(asked: Sequence[Asked]) -> tuple[str, ...]:
    known = (EFFECTS[one.effect].instead for one in asked)
    return tuple(dict.fromkeys(words for words in known if words is not None))
