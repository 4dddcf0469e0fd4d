"""What a trace begins with: the noise that is asked for, the calibrated physics, faulty sightings, and its time.

Searches are left when their part of the time is up, and the answer says so. Calibration, noise and the fit of the
declared physics are never cut short, for without them there is no answer. What is left of the limit then, and a quarter
of it at least, goes to the search and the proposed experiment in turn; what the one does not need the other has. A run
that is remembered takes no time, so a trace that resumes goes on where its searches were left.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from physworld.calibrate import Journal, calibrate
from physworld.engine.formulations import RODS
from physworld.estimation.faults import Faults, find_faults
from physworld.estimation.noise import noise_sigma
from physworld.estimation.simulations import Job, Ledger, Memory, Progress, Runner
from physworld.geometry.reference import ROD_KINDS
from physworld.scene import Scene
from physworld.trace.answer import Verdict
from physworld.trace.config import TraceConfig
from physworld.trace.recordings import JointSimulations, Recordings
from physworld.twin.grips import softly_held
from physworld.twin.twin import Twin

_FAR_BELOW = 3.0  # finer cells change the twin by so many times the noise: then that is what limits a claim


def taken_with(scenes: Sequence[Scene], noise_m: float | None) -> list[Scene]:
    """The recordings with this deviation per axis for their noise [m]; with their own for None.

    Raises:
        ValueError: it is not positive.
    """
    if noise_m is None:
        return list(scenes)
    if not 0.0 < noise_m < np.inf:
        raise ValueError(f"noise of {noise_m} m: a positive number of metres is needed")
    return [scene.with_noise(noise_m) for scene in scenes]


def remarks(sigma: float | None, asked: bool, numerics: Mapping[str, float]) -> list[str]:
    """What is to be said of the noise [m].

    Args:
        sigma: the noise.
        asked: it was asked for, and is not the recording's own.
        numerics: by how many times the noise other cells and time steps change the twin, by name.
    """
    if sigma is None:
        return ["no noise is declared and none can be estimated: no claim"]
    found = [f"noise of {1e3 * sigma:.3g} mm as asked for, not as the recording has it"] if asked else []
    cells = numerics.get("finer cells", 0.0)
    if cells <= _FAR_BELOW:
        return found
    return [
        *found,
        f"finer cells change the twin by {1e3 * cells * sigma:.3g} mm, {cells:.3g} times the noise of "
        f"{1e3 * sigma:.3g} mm: little that is finer than that can be named. How well the experiment repeats, given as "
        "the noise, asks what can be named at that accuracy",
    ]


@dataclass(frozen=True)
class Beginning:
    """Settings and means of a trace, as :func:`physworld.trace.trace` was given them, and what its stages cost."""

    config: TraceConfig
    runner: Runner
    memory: Memory | None
    progress: Progress | None
    cancelled: Callable[[], bool] | None
    ledger: Ledger = field(default_factory=Ledger)
    notes: list[str] = field(default_factory=list)

    def calibrated(
        self, recordings: Recordings, twin: Twin | None, journal: Journal | None
    ) -> tuple[JointSimulations, Twin, int]:
        """The simulations, the declared physics calibrated on the training frames, and the runs that this took."""
        config, runs, begun = self.config, 0, time.perf_counter()
        form, damping = config.calibration.formulation, config.calibration.damping
        if recordings.lead.scene.kind in ROD_KINDS:
            # the search for a rod's stiffness ends in a wrong basin without its losses, which come off later
            damping = "auto" if form in ("auto", RODS.name) else damping
        if twin is None or twin.form.name != (form if form != "auto" else twin.form.name):
            # fibres would go into a free shape of bending, effects into where points lie
            declared = replace(
                config.calibration, bending="declared", formulation=form, damping=damping, placed=False
            )
            fitted = calibrate(
                recordings.lead.scene, declared, self.progress, self.cancelled, journal, runner=self.runner
            )
            twin, runs = fitted.twin, fitted.simulations
            if fitted.cut_short:
                most = config.calibration.max_simulations
                self.notes[:] = [
                    f"the calibration of the declared physics was cut short by its budget of {most} simulations"
                ]
            self.ledger.add("calibration", runs, time.perf_counter() - begun)
        twin = softly_held(twin)
        simulations = JointSimulations(
            recordings, twin, config.calibration.particle_budget, config.refinement, self.runner, self.memory,
            self.progress, self.cancelled,
        )  # fmt: skip
        simulations.ledger = self.ledger
        return simulations, twin, runs

    def faults(self, simulations: JointSimulations, twin: Twin) -> tuple[Faults, ...]:
        """Faulty sightings of every recording that is fitted; none where the noise is not known."""
        recordings = simulations.recordings
        simulations.stage = "sightings"
        tracks = simulations.run([Job(twin, recordings.split.train[1])])[0]
        sigma = None if tracks is None else noise_sigma(recordings.scene, recordings.split, tracks)
        if tracks is None or sigma is None:
            return ()
        return tuple(
            find_faults(
                known.scene.points, known.scene.visible, tracks[:, known.points], known.split,
                known.scene.noise_sigma_m or sigma,
            )
            for known in recordings.fitted
        )  # fmt: skip


SEARCH, EXPERIMENT = 0.85, 1.0
"""By which share of the time that is left when the searches begin a part ends."""
_AT_LEAST = 0.25  # share of the limit that the searches have, however long what comes before them took
_SHOWN = 6  # searches that a reason lists


class Clock:
    """Of one trace.

    Args:
        begun: when it began, by ``time.perf_counter``.
        limit_s: see ``TraceConfig.time_limit_s``.
        ledger: of its simulations, whose end this sets.
    """

    def __init__(self, begun: float, limit_s: float | None, ledger: Ledger) -> None:
        self.begun, self.limit_s, self.ledger = begun, limit_s, ledger
        self._from = self._left = 0.0

    def start(self) -> None:
        """The searches begin."""
        if self.limit_s is not None:
            self._from = time.perf_counter()
            self._left = max(self.limit_s - (self._from - self.begun), _AT_LEAST * self.limit_s)

    @contextmanager
    def until(self, share: float) -> Iterator[None]:
        """A part that ends by this share of the time that was left when the searches began."""
        if self.limit_s is not None:
            self.ledger.ends_at = self._from + share * self._left
        try:
            yield
        finally:
            self.ledger.ends_at = float("inf")

    def told(self, verdict: Verdict) -> Verdict:
        """The verdict, with what was left for want of time."""
        cut = list(dict.fromkeys(self.ledger.cut))
        if not cut:
            return verdict
        more = f" and {len(cut) - _SHOWN} more" if len(cut) > _SHOWN else ""
        left = f"after {self.limit_s:g} s these searches were left: {', '.join(cut[:_SHOWN])}{more}"
        return replace(verdict, reason=f"{verdict.reason}; {left}")
