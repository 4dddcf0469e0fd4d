"""The held-out frames and recordings, read once, for the report: predictions before and after, and their errors.

Errors come with intervals by paired blocks of frames, the noise floor and baselines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.estimation.noise import Split
from physworld.evaluate.baselines import constant_velocity, rigid_follow, static
from physworld.evaluate.metrics import chamfer_l2
from physworld.scene import Scene
from physworld.trace.config import TraceConfig
from physworld.trace.hypotheses import Hypothesis
from physworld.trace.recordings import HELD_OUT, JointSimulations, Recording, Recordings, side_by_side

METRIC = "track_rmse_m"
"""Root mean squared coordinate error of the visible points [m]: sigma for a perfect prediction."""
_BASELINES = {"static": static, "rigid_follow": rigid_follow, "constant_velocity": constant_velocity}
_SHORTEST_BLOCK = 3


@dataclass(frozen=True)
class HeldOut:
    """Errors on the held-out frames [m]; ``after_ci95`` and ``gain_ci95`` (before minus after) by paired blocks."""

    noise_floor: float | None
    before: float
    after: float
    after_ci95: tuple[float, float]
    gain_ci95: tuple[float, float]
    chamfer_before: float
    chamfer_after: float
    baselines: dict[str, float]
    explained_fraction: float | None


def measure(
    scene: Scene,
    split: Split,
    before: Array,
    after: Array,
    sigma: float | None,
    resamples: int,
    seed: int,
) -> HeldOut:
    """Measure two predictions (T, N, 3) on the held-out frames.

    Args:
        scene, split: what was measured, and which of it was held out.
        before, after: predictions, (T, N, 3) [m].
        sigma: noise per axis [m], None where it is not known.
        resamples: of the intervals' blocks.
        seed: of these.
    """
    return measure_all([Unseen(scene, split, before, after)], sigma, resamples, seed)


@dataclass(frozen=True)
class Unseen:
    """Held-out frames of one recording, with the predictions before and after, (T, N, 3) [m]."""

    scene: Scene
    split: Split
    before: Array
    after: Array

    @property
    def window(self) -> slice:
        """Its frames."""
        return slice(*self.split.test)

    def squares(self, tracks: Array) -> Array:
        """Sum of squared coordinate errors and their number in every frame, (F, 2)."""
        return _per_frame(self.scene, tracks, self.window)

    def chamfer(self, tracks: Array) -> float:
        """Mean over its frames [m]."""
        return chamfer_l2(
            tracks[self.window], self.scene.points[self.window], self.scene.visible[self.window]
        )


def measure_all(parts: Sequence[Unseen], sigma: float | None, resamples: int, seed: int) -> HeldOut:
    """Measure predictions on the held-out frames of several recordings together, every coordinate alike.

    Args:
        parts: the recordings with their predictions.
        sigma: noise per axis [m], None where it is not known.
        resamples: of the intervals' blocks.
        seed: of these.
    """
    squares_before = np.concatenate([part.squares(part.before) for part in parts])
    squares_after = np.concatenate([part.squares(part.after) for part in parts])
    low_high = _intervals(squares_before, squares_after, resamples, seed)
    was, now = _root(squares_before), _root(squares_after)
    above = was - (sigma or 0.0)
    frames = [part.split.test[1] - part.split.test[0] for part in parts]
    return HeldOut(
        noise_floor=sigma,
        before=was,
        after=now,
        after_ci95=low_high[0],
        gain_ci95=low_high[1],
        chamfer_before=float(np.average([part.chamfer(part.before) for part in parts], weights=frames)),
        chamfer_after=float(np.average([part.chamfer(part.after) for part in parts], weights=frames)),
        baselines={
            name: _root(np.concatenate([part.squares(predict(part.scene)) for part in parts]))
            for name, predict in _BASELINES.items()
        },
        explained_fraction=(was - now) / above if sigma and above > 0 else None,
    )


def _per_frame(scene: Scene, tracks: Array, window: slice) -> Array:
    """Sum of squared coordinate errors and their number in every frame, (F, 2)."""
    seen = scene.visible[window]
    square = np.where(seen[..., None], (tracks[window] - scene.points[window]) ** 2, 0.0)
    return np.stack([square.sum(axis=(1, 2)), 3.0 * seen.sum(axis=1)], axis=1)


def _root(square: Array) -> float:
    total = square.sum(axis=0)
    return float(np.sqrt(total[0] / total[1])) if total[1] else float("nan")


def _intervals(
    before: Array, after: Array, resamples: int, seed: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Moving blocks of frames, the same for both predictions."""
    frames = len(before)
    length = max(_SHORTEST_BLOCK, round(frames ** (1 / 2)))
    rng = np.random.default_rng(seed)
    starts = rng.integers(0, max(frames - length, 0) + 1, size=(resamples, -(-frames // length)))
    picked = (starts[..., None] + np.arange(min(length, frames))).reshape(resamples, -1)
    was, now = (
        np.sqrt(s[picked, 0].sum(axis=1) / np.maximum(s[picked, 1].sum(axis=1), 1)) for s in (before, after)
    )
    (low, high), (least, most) = (np.quantile(values, [0.025, 0.975]) for values in (now, was - now))
    return (float(low), float(high)), (float(least), float(most))


@dataclass(frozen=True)
class Outcome:
    """One recording of several: its role (fitted, held_out), scored frames, open-loop tracks (T, N, 3) [m], errors."""

    scene: str
    role: str
    frames: tuple[int, int]
    before: Array
    after: Array
    held_out: HeldOut


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

    def of(self, declared: Hypothesis, model: Hypothesis, sigma: float | None) -> list[Outcome]:
        """Open-loop predictions of every recording before and after, and their errors on frames that were not used.

        Args:
            declared: the declared physics.
            model: what the verdict takes.
            sigma: noise per axis [m], None where it is not known.
        """
        every = [*self.recordings.fitted, *self.recordings.held_out]
        before, after = (self._predictions(m, every) for m in (declared, model))
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

    def _predictions(self, model: Hypothesis, recordings: list[Recording]) -> list[Array]:
        """Open loop over all frames, [(T, N, 3)], with the points' own places from the training frames."""
        places = model.white.place_errors(model.fitted.tracks)
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
