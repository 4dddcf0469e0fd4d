"""Several recordings of one object in one calibration: one material, and of every recording what belongs to it.

Of the object are law, drag, friction, flow law and what fades of its stiffness: a number of that kind is one unknown.
Of a recording are its body, start and grips, how long a hand took to open, and of a discrete rod its rest shape and
what drives it from inside: such a number is an unknown of every recording, called ``recording_2.NAME`` in the second.
Residuals stand one recording after the other, every coordinate alike. The first recording leads: an object's numbers
have the starts and bounds that its scene gives them, and the windows of a search are counted in its frames, of which
another recording sees the same share.

Whether recordings agree is asked at the common optimum. The residuals r and sensitivities J of one recording alone say
where its own optimum lies, theta - (J^T J + P)^-1 J^T r, to first order, P being the priors about the common optimum
where there are priors. How far that is, in deviations of what this recording knows, is its *shift*.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.descents import Optimum, Place
from physworld.calibrate.estimates import training_losses
from physworld.calibrate.parameters import OF_RECORDING, Parameter
from physworld.calibrate.places import placed_as_seen
from physworld.calibrate.search import Progress, Search
from physworld.errors import SceneUnsupported
from physworld.estimation.journal import Journal
from physworld.estimation.least_squares import Solution, block_covariance
from physworld.estimation.simulations import Job, Runner, in_turn
from physworld.estimation.unknowns import at
from physworld.scene import Scene
from physworld.twin.build import taken_over
from physworld.twin.twin import Twin

SAYS_NOTHING = 0.9
"""Share of a prior's deviation: a recording that leaves more of it says nothing of the number."""

_APART = 3.0  # deviations: a recording whose own optimum is farther off disagrees


@dataclass(frozen=True)
class Recorded:
    """What a calibration predicts of one recording.

    Attributes:
        scene: the recording.
        twin: its own, with the object's numbers.
        tracks: tracked points over all frames, open loop from the first, (T, N, 3) [m].
        particles: particles over all frames, (T, P, 3) [m].
        losses: see :func:`physworld.calibrate.estimates.training_losses`.
    """

    scene: Scene
    twin: Twin
    tracks: Array
    particles: Array
    losses: dict[str, Any]


@dataclass(frozen=True)
class Agreement:
    """Whether recordings agree on a number of the object.

    Attributes:
        name: of the number.
        unit: its unit.
        value: of all recordings together.
        own: each recording's own optimum to first order; None where the recording says nothing of the number.
        shifts: how far that is from ``value``, in deviations of what the recording knows.
    """

    name: str
    unit: str
    value: float
    own: tuple[float | None, ...]
    shifts: tuple[float | None, ...]

    @property
    def agrees(self) -> bool:
        """Whether no recording's own optimum is more than three deviations off."""
        return all(shift is None or abs(shift) <= _APART for shift in self.shifts)


def recorded(scene: Scene, twin: Twin, placed: bool) -> Recorded:
    """What a calibrated twin predicts of its recording.

    Args:
        scene: the recording.
        twin: calibrated.
        placed: find where its tracked points lie in the body (:mod:`physworld.calibrate.places`).
    """
    nodes = twin.simulate_nodes(*scene.control_track(), scene.times)
    if placed:
        twin = placed_as_seen(scene, twin, nodes)
    tracks = twin.observe(nodes, scene.times)
    return Recorded(scene, twin, tracks, twin.particles_at(nodes), training_losses(scene, tracks))


def of_one_object(twins: Sequence[Twin]) -> list[Twin]:
    """The twins of several recordings before a calibration, all with the first one's material.

    Raises:
        SceneUnsupported: their bodies are of different forms, so that no material fits all of them.
    """
    if not twins:
        raise SceneUnsupported("a calibration needs a recording; it has 0")
    forms = [(twin.form.title, twin.lattice.dim, type(twin.law).name) for twin in twins]
    if len(set(forms)) > 1:
        said = "; ".join(f"{title}, dimension {dim}, {law}" for title, dim, law in forms)
        raise SceneUnsupported(
            f"recordings of one object have one form of body and one law; these have {said}"
        )
    return [twins[0], *(replace(taken_over(twins[0], own), natural=own.natural) for own in twins[1:])]


def together(
    each: Sequence[Sequence[Parameter]], own: Callable[[str], bool] = OF_RECORDING.__contains__
) -> list[Parameter]:
    """The numbers of the object once, then of every recording those that belong to it.

    Args:
        each: what could be searched of every recording alone.
        own: whether a number of that name belongs to its recording.
    """
    if len(each) == 1:
        return list(each[0])
    shared: dict[str, Parameter] = {}
    belonging = []
    for k, known in enumerate(each):
        for parameter in known:
            if own(parameter.name):
                name = parameter.name if k == 0 else f"recording_{k + 1}.{parameter.name}"
                belonging.append(replace(parameter, name=name, recording=k))
            else:
                shared.setdefault(parameter.name, parameter)
    return [*shared.values(), *belonging]


def of_recording(parameters: Sequence[Parameter], recording: int) -> list[int]:
    """Which parameters change what is predicted of a recording: the object's, and its own."""
    return [k for k, p in enumerate(parameters) if p.recording in (None, recording)]


def twin_at(twin: Twin, parameters: Sequence[Parameter], theta: Array, recording: int) -> Twin:
    """A recording's twin with the object's numbers and its own.

    Args:
        twin: that of the recording.
        parameters: of all recordings (p).
        theta: in the scale of the search, (p,).
        recording: its number.
    """
    places = of_recording(parameters, recording)
    return at(twin, [parameters[k] for k in places], theta[places])


def agreement_of(
    parameters: Sequence[Parameter], theta: Array, shifted: Sequence[tuple[list[int], Array, Array]]
) -> tuple[Agreement, ...]:
    """The agreement of recordings on every number of the object.

    Args:
        parameters: what was searched (p).
        theta: the common optimum, (p,).
        shifted: of every recording the places of its parameters (q), its own shift (q,) and its deviations (q,).
    """
    found = []
    for k, parameter in enumerate(parameters):
        if parameter.recording is not None:
            continue
        own: list[float | None] = []
        shifts: list[float | None] = []
        for places, shift, deviation in shifted:
            row = places.index(k)
            known = bool(np.isfinite(deviation[row])) and deviation[row] > 0.0
            there = float(np.clip(theta[k] + shift[row], *parameter.bounds))
            own.append(parameter.value(there) if known else None)
            shifts.append(float(shift[row] / deviation[row]) if known else None)
        found.append(
            Agreement(
                parameter.name, parameter.unit, parameter.value(float(theta[k])), tuple(own), tuple(shifts)
            )
        )
    return tuple(found)


@dataclass(frozen=True)
class _Jobs(Job):
    """A simulation of every recording at one place; what it has of a job itself is the first recording's."""

    each: tuple[Job, ...] = ()


class SharedSearch(Search):
    """The search of a calibration over several recordings; see :class:`Search`.

    A run is one simulation of every recording.

    Args:
        scenes: whose training frames are scored, the one that leads first.
        twins: of the recordings, with one material.
        max_simulations, progress, cancelled, journal, runner: of the search.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        twins: Sequence[Twin],
        max_simulations: int,
        progress: Progress | None,
        cancelled: Callable[[], bool] | None,
        journal: Journal | None = None,
        runner: Runner = in_turn,
    ) -> None:
        self.parts: list[Search] = []
        settings = (max_simulations, progress, cancelled, journal or Journal(), runner)
        super().__init__(scenes[0], twins[0], *settings)
        for scene, twin in zip(scenes, twins, strict=True):
            self.parts.append(Search(scene, twin, *settings[:1], None, cancelled, self.journal, runner))

    @property
    def twins(self) -> list[Twin]:
        """What candidates differ from, a twin for every recording."""
        return [part.twin for part in self.parts]

    @twins.setter
    def twins(self, twins: list[Twin]) -> None:
        self.twin = twins[0]
        for part, twin in zip(self.parts, twins, strict=True):
            part.twin = twin

    def at(self, parameters: Sequence[Parameter], theta: Array, recording: int = 0) -> Twin:
        """The twin of a recording at a place: see :meth:`Search.at`."""
        return twin_at(self.parts[recording].twin, parameters, theta, recording)

    def first_window(self) -> int:
        """The shortest share that a recording's first window has of its training frames, in the first one's frames."""
        share = min((part.first_window() - part.begin) / (part.end - part.begin) for part in self.parts)
        return self.begin + max(1, round(share * (self.end - self.begin)))

    def frame_of_residual(self, end: int) -> Array:
        """Frame of every entry of a residual, counted on from recording to recording."""
        begun = np.cumsum([0, *(part.end for part in self.parts)])
        return np.concatenate(
            [
                first + part.frame_of_residual(last)
                for first, (part, last) in zip(begun, self._ends(end), strict=False)
            ]
        )

    def point_of_residual(self) -> Array:
        """Tracked point of every entry of a residual, counted on from recording to recording."""
        begun = np.cumsum([0, *(part.scene.points.shape[1] for part in self.parts)])
        return np.concatenate(
            [first + part.point_of_residual() for first, part in zip(begun, self.parts, strict=False)]
        )

    def job(self, place: Place) -> Job:
        """The simulations of a place."""
        parameters, theta, end = place
        last = self.end if end is None else end
        each = tuple(Job(self.at(parameters, theta, k), own) for k, (_, own) in enumerate(self._ends(last)))
        return _Jobs(each[0].twin, last, each=each)

    def run(self, jobs: list[Job]) -> Iterator[Array | None]:
        """Tracks of all recordings in a row, flat, by the runner; None where one of them cannot be trusted."""
        if not jobs:
            return
        found = [list(part.run([_each(job)[k] for job in jobs])) for k, part in enumerate(self.parts)]
        for several in zip(*found, strict=True):
            known = [tracks.reshape(-1) for tracks in several if tracks is not None]
            yield np.concatenate(known) if len(known) == len(several) else None

    def compared(self, job: Job, tracks: Array | None) -> tuple[Array, float | None]:
        """Residual of all recordings and its root mean square [m], None where a run failed."""
        if tracks is None:
            return self._nothing(job.frames), None
        found, begin = [], 0
        for own, part in zip(_each(job), self.parts, strict=True):
            shape = (own.frames, part.scene.points.shape[1], 3)
            size = int(np.prod(shape))
            found.append(part.compared(own, tracks[begin : begin + size].reshape(shape))[0])
            begin += size
        residual = np.concatenate(found)
        return residual, float(np.sqrt(np.mean(residual**2)))

    def shift_points(self, parameters: list[Parameter], theta: Array, placed: bool = True) -> bool:
        """Move the tracked points of every recording: see :meth:`Search.shift_points`."""
        moved = [
            self._lent(
                part, lambda part, own, there: part.shift_points(own, there, placed), k, parameters, theta
            )
            for k, part in enumerate(self.parts)
        ]
        self.twin = self.parts[0].twin
        return any(moved)

    def mistaken(self, parameters: list[Parameter], optimum: Optimum) -> list[Array]:
        """Changes of the residual by what the controllers of each recording may err by: see :meth:`Search.mistaken`."""
        sizes = [len(part.point_of_residual()) for part in self.parts]
        found = []
        for k, part in enumerate(self.parts):
            changes = self._lent(
                part,
                lambda part, own, there: part.mistaken(own, Optimum(there, optimum.cost)),
                k,
                parameters,
                optimum.theta,
            )
            found += [np.pad(change, (sum(sizes[:k]), sum(sizes[k + 1 :]))) for change in changes]
        return found

    def agreement(self, parameters: list[Parameter], solution: Solution) -> tuple[Agreement, ...]:
        """Whether the recordings agree on the object's numbers, by the sensitivities at the common optimum."""
        shifted, begin = [], 0
        for k, part in enumerate(self.parts):
            frames, points = part.frame_of_residual(part.end), part.point_of_residual()
            rows, places = slice(begin, begin + len(points)), of_recording(parameters, k)
            residual, jacobian = solution.residual[rows], solution.jacobian[rows][:, places]
            shift = -np.linalg.lstsq(jacobian, residual, rcond=None)[0]
            left = residual + jacobian @ shift
            alone = Solution(solution.theta[places] + shift, float(np.mean(left**2)), left, jacobian)
            deviation = np.sqrt(np.maximum(np.diag(block_covariance(alone, frames, points)), 0.0))
            shifted.append((places, shift, deviation))
            begin += len(points)
        return agreement_of(parameters, solution.theta, shifted)

    def _ends(self, end: int) -> list[tuple[Search, int]]:
        """Where frames up to ``end`` of the first recording end in every recording."""
        share = (end - self.begin) / (self.end - self.begin)
        return [
            (part, min(part.end, part.begin + max(1, round(share * (part.end - part.begin)))))
            for part in self.parts
        ]

    def _lent(
        self,
        part: Search,
        what: Callable[[Search, list[Parameter], Array], Any],
        recording: int,
        parameters: list[Parameter],
        theta: Array,
    ) -> Any:
        """What a recording's own search gives, its runs counted here."""
        places = of_recording(parameters, recording)
        part.simulations, part.limit, part.cut_short = self.simulations, self.limit, self.cut_short
        part.history = self.history
        found = what(part, [parameters[k] for k in places], theta[places])
        self.simulations, self.cut_short, self.history = part.simulations, part.cut_short, part.history
        return found

    def _nothing(self, end: int | None) -> Array:
        ends = self._ends(self.end if end is None else end)
        return np.concatenate([part._nothing(last) for part, last in ends])


def _each(job: Job) -> tuple[Job, ...]:
    assert isinstance(job, _Jobs)
    return job.each
