"""What a trace's models predict of frames and recordings that were not used, and how far off that is."""

from __future__ import annotations

from physworld.arrays import Array
from physworld.estimation.whitening import Whitener
from physworld.scene import Scene
from physworld.trace.config import TraceConfig
from physworld.trace.confirm import Model
from physworld.trace.held_out import HeldOut, Unseen, measure, measure_all
from physworld.trace.recordings import HELD_OUT, JointSimulations, Recording, Recordings, side_by_side
from physworld.trace.result import Outcome


class Outcomes:
    """Of the recordings of one trace.

    Attributes:
        notes: of runs that could not be trusted.
    """

    def __init__(self, recordings: Recordings, simulations: JointSimulations, config: TraceConfig) -> None:
        self.recordings, self.simulations, self.config = recordings, simulations, config
        self.notes: list[str] = []

    @property
    def scene(self) -> Scene:
        """All that are fitted, side by side."""
        return self.recordings.scene

    def of(self, declared: Model, model: Model, white: Whitener, sigma: float | None) -> list[Outcome]:
        """Open-loop predictions of every recording before and after, and their errors on frames that were not used."""
        every = [*self.recordings.fitted, *self.recordings.held_out]
        before, after = (self._predictions(m, white, every) for m in (declared, model))
        found = []
        for recording, was, now in zip(every, before, after, strict=True):
            noise = recording.scene.noise_sigma_m or sigma
            errors = measure(
                recording.scene, recording.split, was, now, noise, self.config.bootstraps, self.config.seed
            )
            found.append(
                Outcome(recording.scene.name, recording.role, recording.split.test, was, now, errors)
            )
        return found

    def together(self, outcomes: list[Outcome], sigma: float | None) -> HeldOut:
        """Those of several recordings together."""
        if len(outcomes) == 1:
            return outcomes[0].held_out
        parts = [
            Unseen(recording.scene, recording.split, outcome.before, outcome.after)
            for recording, outcome in zip(self._recordings_of(outcomes), outcomes, strict=True)
        ]
        return measure_all(parts, sigma, self.config.bootstraps, self.config.seed)

    def _recordings_of(self, outcomes: list[Outcome]) -> tuple[Recording, ...]:
        return self.recordings.held_out if outcomes[0].role == HELD_OUT else self.recordings.fitted

    def _predictions(self, model: Model, white: Whitener, recordings: list[Recording]) -> list[Array]:
        """Open loop over all frames, [(T, N, 3)], with the points' own places from the training frames."""
        places = white.place_errors(model.fitted.tracks)
        found = []
        for recording, tracks in zip(
            recordings, self.simulations.predictions(model.fitted.twin, places), strict=True
        ):
            if tracks is None:
                self.notes.append(
                    f"{recording.scene.name}: the run over the frames that were not used cannot be trusted; the last "
                    "training frame, or without one the first frame, is kept"
                )
                known = model.fitted.tracks[: recording.split.train[1], recording.points]
                if recording.role == HELD_OUT:
                    known = recording.scene.points[:1]
                tracks = side_by_side([known], recording.scene.frame_count)
            found.append(tracks)
        return found
