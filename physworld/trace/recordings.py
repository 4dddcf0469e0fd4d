"""Several recordings of one object: one set of material parameters and effects, a twin for each recording.

Every recording starts the body elsewhere, holds it and drives it in its own way, so each has a twin of its own. What a
trace estimates, the law's parameters, friction and the effects, is the same for all: the *lead*, the first recording's
twin, carries it, and the others take it over before every run. Their measurements stand side by side in one scene,
points after points; a recording that ended is not visible from there on. To everything that works on tracks,
residuals and sensitivities this is one scene with more points.

Recordings that are held out are never simulated before the report. Of them nothing but the first frame, which starts
the twin (and, "as measured", the velocity there), and the controls is used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.engine.thin.triangles import mesh_of
from physworld.errors import SceneUnsupported
from physworld.estimation.noise import Split, freeze
from physworld.estimation.simulations import (
    Drive,
    Job,
    Memory,
    Progress,
    Runner,
    Simulations,
    in_turn,
    nodes_of,
)
from physworld.estimation.whitening import moved, responses
from physworld.evaluate.numerics import refined
from physworld.scene import Scene, covariances_of, sigma_of
from physworld.twin.build import build_twin, taken_over
from physworld.twin.twin import Twin

FITTED, HELD_OUT = "fitted", "held_out"


@dataclass(frozen=True)
class Recording:
    """One recording.

    Attributes:
        scene: with the frozen split as its train and test frames.
        split: of a held-out recording: no training frames, all but frame 0 are scored.
        role: FITTED or HELD_OUT.
        points: its columns in the joined scene; of a held-out one its own.
    """

    scene: Scene
    split: Split
    role: str
    points: slice

    @property
    def drive(self) -> Drive:
        """What drives its simulations."""
        return Drive(*self.scene.control_track(), self.scene.times)


class Recordings:
    """The recordings of one trace.

    Attributes:
        fitted, held_out: in the order given.
        scene: those that are fitted as one scene, their training frames only; the scene itself where there is one.
        split: of the joined scene. The constructor has the arguments of :func:`freeze`, for several scenes.
    """

    def __init__(
        self, scenes: Sequence[Scene], held_out: Sequence[Scene], blocks: int, shortest_block: int
    ) -> None:
        if not scenes:
            raise SceneUnsupported(f"a trace needs a recording to fit; it has 0 and {len(held_out)} held out")
        _require_alike([*scenes, *held_out])
        fitted, column = [], 0
        for scene in scenes:
            split = freeze(scene, blocks, shortest_block)
            own = replace(scene, train=split.train, test=split.test)
            fitted.append(Recording(own, split, FITTED, slice(column, column + scene.points.shape[1])))
            column += scene.points.shape[1]
        self.fitted = tuple(fitted)
        self.held_out = tuple(_unseen(scene) for scene in held_out)
        self.scene = self.fitted[0].scene if len(fitted) == 1 else _joined(self.fitted)
        self.split = self.fitted[0].split if len(fitted) == 1 else _common(self.fitted)

    @property
    def lead(self) -> Recording:
        """The first."""
        return self.fitted[0]


class JointSimulations(Simulations):
    """Simulations of all fitted recordings under one twin; tracks stand side by side, (frames, N1 + N2 + …, 3)."""

    def __init__(
        self,
        recordings: Recordings,
        twin: Twin,
        budget: int,
        refinement: float,
        runner: Runner = in_turn,
        memory: Memory | None = None,
        progress: Progress | None = None,
        cancelled: Callable[[], bool] | None = None,
    ) -> None:
        """``twin``: the lead's; ``budget``, ``refinement``: of cells; the other arguments of :class:`Simulations`."""
        super().__init__(recordings.lead.drive, runner, memory, progress, cancelled)
        self.recordings, self._budget = recordings, budget
        self._drives = [recording.drive for recording in recordings.fitted]
        self._levels: list[tuple[Twin, list[Twin]]] = []
        factors = (1.0, refinement, 1.0 / refinement) if twin.lattice.smooth else (1.0,)
        for factor in factors if len(recordings.fitted) > 1 else ():
            lead = twin if factor == 1.0 else refined(recordings.lead.scene, twin, budget, factor)
            others = [placed_in(r.scene, twin, budget, factor) for r in recordings.fitted[1:]]
            self._levels.append((lead, others))

    def run(self, jobs: Sequence[Job]) -> list[Array | None]:
        """Tracks of every job, those of all recordings side by side; None where one cannot be trusted."""
        found = [
            self.under(drive, [self._cut(job, k) for job in jobs]) for k, drive in enumerate(self._drives)
        ]
        return [
            None
            if any(t is None for t in own)
            else side_by_side([t for t in own if t is not None], job.frames)
            for job, own in zip(jobs, zip(*found, strict=True), strict=True)
        ]

    def first_look(self, job: Job) -> tuple[Array, Array]:
        """Tracks (frames, N, 3) and how they answer to the points' own places, (frames, N, 3, 3).

        Raises:
            SimulationError: a run cannot be trusted.
        """
        tracks, answers = [], []
        for k, drive in enumerate(self._drives):
            cut = self._cut(job, k)
            nodes = nodes_of(cut, drive)
            tracks.append(cut.twin.observe(nodes, drive.times[: cut.frames]))
            answers.append(responses(cut.twin, nodes))
        return side_by_side(tracks, job.frames), side_by_side(answers, job.frames)

    def predictions(self, twin: Twin, places: Array) -> list[Array | None]:
        """Open loop over all frames of every recording, the held-out ones last, [(T, N, 3)].

        Args:
            twin: the lead's.
            places: errors of the fitted points' own places [m], (N, r); of recordings that are held out none are known.
        """
        found: list[Array | None] = []
        for k, recording in enumerate(self.recordings.fitted):
            own = moved(self._twin_of(twin, k), places[recording.points])
            found += self.under(recording.drive, [Job(own, recording.scene.frame_count)])
        for recording in self.recordings.held_out:
            own = placed_in(recording.scene, twin, self._budget)
            found += self.under(recording.drive, [Job(own, recording.scene.frame_count)])
        return found

    def _cut(self, job: Job, k: int) -> Job:
        """The job on recording ``k``."""
        if len(self._drives) == 1:
            return job
        frames = min(job.frames, self.recordings.fitted[k].split.train[1])
        return replace(job, twin=self._twin_of(job.twin, k), frames=frames)

    def _twin_of(self, twin: Twin, k: int) -> Twin:
        if k == 0:
            return twin
        for lead, others in self._levels:
            if np.array_equal(lead.lattice.particle_coordinates, twin.lattice.particle_coordinates):
                return taken_over(twin, others[k - 1])
        raise ValueError(
            f"no twin of recording {k} has the cells {twin.lattice.spacing} m of the first one's"
        )


def placed_in(scene: Scene, twin: Twin, budget: int, refinement: float = 1.0) -> Twin:
    """A recording's own body, start and grips with the parameters and effects of another recording's twin.

    Args:
        scene: the recording.
        twin: of another recording of the same object; of a mesh of triangles if that is one.
        budget, refinement: particles of the body, and how many times finer its cells are.

    Raises:
        SceneUnsupported: the recording does not say enough for a body of the twin's form.
    """
    return taken_over(twin, build_twin(
        scene, budget, twin.device, refinement, twin.plasticity, twin.formulation, twin.transfer,
        mesh_of(twin.lattice),
    ))  # fmt: skip


def side_by_side(parts: Sequence[Array], frames: int) -> Array:
    """Arrays (T_k, N_k, …) as one (frames, N1 + N2 + …, …); after its end a recording repeats its last frame."""
    padded = [np.concatenate([p[:frames], np.repeat(p[-1:], max(frames - len(p), 0), axis=0)]) for p in parts]
    return padded[0] if len(padded) == 1 else np.concatenate(padded, axis=1)


def _unseen(scene: Scene) -> Recording:
    everything = (1, scene.frame_count)
    split = Split((0, 1), everything, np.array([0, 1]))
    return Recording(replace(scene, train=(0, scene.frame_count), test=everything), split, HELD_OUT,
                     slice(0, scene.points.shape[1]))  # fmt: skip


def _joined(fitted: Sequence[Recording]) -> Scene:
    """Training frames of all recordings as one scene; its noise is the largest, if all declare one."""
    lead = fitted[0].scene
    frames = max(recording.split.train[1] for recording in fitted)
    longest = max(fitted, key=lambda recording: recording.scene.frame_count).scene
    visible = []
    for recording in fitted:
        seen = recording.scene.visible.copy()
        seen[1 : recording.split.train[0]] = seen[recording.split.train[1] :] = (
            False  # frame 0 places the points
        )
        missing = max(frames - len(seen), 0)
        visible.append(np.concatenate([seen[:frames], np.zeros((missing, seen.shape[1]), dtype=bool)]))
    known = [noise for recording in fitted if (noise := recording.scene.noise_sigma_m)]
    covariances = covariances_of([recording.scene for recording in fitted])
    sigma = sigma_of(covariances) if covariances is not None else max(known, default=0.0)
    return replace(
        lead,
        points=side_by_side([recording.scene.points for recording in fitted], frames),
        visible=np.concatenate(visible, axis=1),
        controllers=side_by_side([lead.controllers], frames),
        times=longest.times[:frames],
        noise_sigma_m=sigma if len(known) == len(fitted) else None,
        noise_covariance_m2=covariances if len(known) == len(fitted) else None,
        train=(min(recording.split.train[0] for recording in fitted), frames),
        test=(frames, frames),
    )


def _common(fitted: Sequence[Recording]) -> Split:
    """Training frames of all; blocks of as many frames as the longest recording has them."""
    longest = max((recording.split for recording in fitted), key=lambda split: split.train[1])
    first = min(recording.split.train[0] for recording in fitted)
    edges = np.concatenate([[first], longest.edges[1:]])
    return Split((first, longest.train[1]), (longest.train[1], longest.train[1]), edges)


def _require_alike(scenes: Sequence[Scene]) -> None:
    """Raises SceneUnsupported where recordings are of objects of different kinds."""
    kinds = {scene.kind for scene in scenes}
    if len(kinds) > 1:
        raise SceneUnsupported(f"recordings of one object have one kind; these have {sorted(kinds)}")
