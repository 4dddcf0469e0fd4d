"""What the page's pictures show, from a scene and two predictions: residuals over time and over the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.evaluate.baselines import constant_velocity, rigid_follow, static
from physworld.scene import Scene

BASELINES = {"static": static, "rigid_follow": rigid_follow, "constant_velocity": constant_velocity}


@dataclass(frozen=True)
class Residuals:
    """Measured minus predicted, NaN where a point was not seen.

    Attributes:
        times: (T,) [s].
        before, after: (T, N, 3) [m].
        baselines: root mean squared coordinate error of every frame by name, (T,) [m].
        split: first held-out frame.
        order: tracked points along the body's longest axis, (N,).
    """

    times: Array
    before: Array
    after: Array
    baselines: dict[str, Array]
    split: int
    order: Array

    @property
    def same(self) -> bool:
        """Whether nothing was added: one prediction only."""
        return bool(np.array_equal(self.before, self.after, equal_nan=True))

    @property
    def split_s(self) -> float | None:
        """Time of the first held-out frame [s]; None where nothing is held out."""
        return float(self.times[self.split]) if self.split < len(self.times) else None


def residuals(scene: Scene, before: Array, after: Array, split: int) -> Residuals:
    """Residuals of two predictions (T, N, 3) [m].

    Args:
        scene: what was measured.
        before, after: predictions, (T, N, 3) [m].
        split: first frame that was held out.

    Raises:
        ValueError: a prediction is not shaped as the scene's points.
    """
    for tracks in (before, after):
        if tracks.shape != scene.points.shape:
            raise ValueError(f"tracks of shape {tracks.shape} for points of shape {scene.points.shape}")
    seen = scene.visible[..., None]
    return Residuals(
        times=scene.times,
        before=measured_minus(scene, before),
        after=measured_minus(scene, after),
        baselines={
            name: per_frame(np.where(seen, scene.points - predict(scene), np.nan))
            for name, predict in BASELINES.items()
        },
        split=split,
        order=along_body(scene),
    )


def measured_minus(scene: Scene, tracks: Array) -> Array:
    """Measured minus predicted (T, N, 3) [m], NaN where a point was not seen."""
    return np.where(scene.visible[..., None], scene.points - tracks, np.nan)


def along_body(scene: Scene) -> Array:
    """Tracked points along the body's longest axis in the first frame, (N,); unseen ones are in its middle."""
    seen = scene.visible[0][:, None]
    middle = np.where(seen, scene.points[0], 0.0).sum(axis=0) / max(int(seen.sum()), 1)
    first = np.where(seen, scene.points[0] - middle, 0.0)
    axis = np.linalg.svd(first, full_matrices=False)[2][0]
    return np.argsort(first @ axis, kind="stable")


def per_frame(residual: Array) -> Array:
    """Root mean squared coordinate of (T, N, 3) in every frame, (T,); NaN where nothing was seen."""
    return _root_mean(residual, (1, 2))


def per_point(residual: Array) -> Array:
    """Root mean squared coordinate of (T, N, 3) of every point, (N,); NaN where it was never seen."""
    return _root_mean(residual, (0, 2))


def carpet(residual: Array, order: Array) -> Array:
    """Length of the residual (T, N, 3) over points in their order and frames, (N, T)."""
    lengths: Array = np.linalg.norm(residual, axis=2).T[order]
    return lengths


def mean_component(residual: Array, axis: int) -> Array:
    """Mean over the seen points of one component, (T,), with its sign."""
    values = residual[..., axis]
    seen = np.isfinite(values)
    total = np.where(seen, values, 0.0).sum(axis=1)
    return np.where(seen.any(axis=1), total / np.maximum(seen.sum(axis=1), 1), np.nan)


def _root_mean(residual: Array, axes: tuple[int, int]) -> Array:
    seen = np.isfinite(residual)
    count = seen.sum(axis=axes)
    square = np.where(seen, residual, 0.0) ** 2
    return np.where(count > 0, np.sqrt(square.sum(axis=axes) / np.maximum(count, 1)), np.nan)
