"""What a trace begins with: the declared physics calibrated, and sightings that are faulty found."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from physworld.calibrate import Journal, calibrate
from physworld.estimation.noise import noise_sigma
from physworld.estimation.simulations import Job, Ledger, Memory, Progress, Runner
from physworld.trace.config import TraceConfig
from physworld.trace.faults import Faults, find_faults
from physworld.trace.recordings import JointSimulations, Recordings
from physworld.twin.grips import softly_held
from physworld.twin.twin import Twin


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
        if twin is None:
            # fibres would go into a free shape of bending
            declared = replace(config.calibration, bending="declared")
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
