"""The held-out frames, read once, for the report: errors before and after, their intervals, floor and baselines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.estimation.noise import Split
from physworld.evaluate.baselines import constant_velocity, rigid_follow, static
from physworld.evaluate.metrics import chamfer_l2
from physworld.scene import Scene

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
    """Measure two predictions (T, N, 3) on the held-out frames."""
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
    """Measure predictions on the held-out frames of several recordings together, every coordinate alike."""
    squares = [
        np.concatenate([part.squares(tracks) for part, tracks in zip(parts, kind, strict=True)])
        for kind in ([p.before for p in parts], [p.after for p in parts])
    ]
    low_high = _intervals(*squares, resamples, seed)
    was, now = (_root(square) for square in squares)
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
    ends = [np.quantile(values, [0.025, 0.975]) for values in (now, was - now)]
    return tuple((float(low), float(high)) for low, high in ends)  # type: ignore[return-value]
