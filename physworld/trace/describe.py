"""What remains, in words: how much, when, where, along what, and what it goes with."""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.scene import Scene

_STRONG = 0.4  # correlation worth a word


def describe(scene: Scene, tracks: Array, frames: tuple[int, int], sigma: float) -> tuple[float, str]:
    """Root mean squared remainder per axis beyond the noise [m], and a description.

    Args:
        tracks: prediction, (T, N, 3) [m].
        frames: half-open range that is described.
        sigma: noise [m].
    """
    window = slice(*frames)
    seen = scene.visible[window]
    error = np.where(seen[..., None], scene.points[window] - tracks[window], 0.0)
    square = (error**2).sum(axis=2) / 3.0
    total = float(square[seen].mean())
    beyond = float(np.sqrt(max(total - sigma**2, 0.0)))
    if beyond < 0.5 * sigma:
        return beyond, "nothing beyond the noise that could be described"
    parts = [_when(square, seen), _where(scene, square, seen), _along(error[seen])]
    parts += _with(scene, tracks, error, seen, window)
    return beyond, "; ".join(part for part in parts if part)


def _when(square: Array, seen: Array) -> str:
    per_frame = square.sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    thirds = [float(np.sqrt(part.mean())) for part in np.array_split(per_frame, 3)]
    trend = (
        "grows" if thirds[2] > 1.5 * thirds[0] else "falls" if thirds[0] > 1.5 * thirds[2] else "is steady"
    )
    return f"it {trend} over time (thirds: {', '.join(f'{1e3 * t:.2g}' for t in thirds)} mm rms)"


def _where(scene: Scene, square: Array, seen: Array) -> str:
    per_point = square.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    start = scene.points[0]
    worst = np.argsort(per_point)[-max(len(per_point) // 10, 1) :]
    share = float(per_point[worst].sum() / max(per_point.sum(), 1e-300))
    centre = start[worst].mean(axis=0)
    place = ", ".join(f"{c:.3f}" for c in centre)
    return f"a tenth of the points, about ({place}) m at the start, carries {share:.0%} of its square"


def _along(error: Array) -> str:
    values, vectors = np.linalg.eigh(error.T @ error)
    share = float(values[-1] / max(values.sum(), 1e-300))
    way = ", ".join(f"{c:+.2f}" for c in vectors[:, -1])
    return f"{share:.0%} of it along ({way})" if share > 0.5 else "it has no main direction"


def _with(scene: Scene, tracks: Array, error: Array, seen: Array, window: slice) -> list[str]:
    """Correlations with motions that a missing law would depend on."""
    velocity = np.gradient(tracks, scene.times, axis=0)
    acceleration = np.gradient(velocity, scene.times, axis=0)
    steady = np.broadcast_to(tracks[:1] - tracks.mean(axis=1, keepdims=True)[:1], tracks.shape)
    fields = {
        "velocity": velocity,
        "speed times velocity": velocity * np.linalg.norm(velocity, axis=2, keepdims=True),
        "acceleration": acceleration,
        "displacement from the start": tracks - tracks[:1],
        "place in the body": steady,
    }
    if len(scene.controllers[0]):
        grip = np.gradient(scene.controllers.mean(axis=1), scene.times, axis=0)
        fields["velocity of the grips"] = np.broadcast_to(grip[:, None], tracks.shape)
    found = []
    for name, values in fields.items():
        there = values[window][seen]
        size = float(np.linalg.norm(there) * np.linalg.norm(error[seen]))
        correlation = float(np.sum(there * error[seen])) / size if size > 0 else 0.0
        if abs(correlation) > _STRONG:
            found.append((abs(correlation), f"it goes with {name} (correlation {correlation:+.2f})"))
    return [text for _, text in sorted(found, reverse=True)[:2]]
