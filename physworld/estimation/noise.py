"""Which frames an inference may look at, and how noisy the tracks are.

The scene's own split where it declares one; else the last 30 % of the frames are held out. Nothing but
:mod:`physworld.trace.held_out` reads measurements of held-out frames.

Noise is declared, or what is left of the measured tracks when everything smooth is taken out: the third difference over
frames of measured minus predicted has 20 times the variance of white noise, while a motion that the frame rate resolves
leaves little; the median over all of them is not moved by the few places where it does. Uneven frame times are fine as
long as they are nearly even.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.scene import Scene

HELD_OUT_SHARE = 0.3
_THIRD = 20.0  # sum of squares of 1, -3, 3, -1
_MEDIAN_OF_NORMAL = 0.6745
_FEWEST = 30


@dataclass(frozen=True)
class Split:
    """Half-open frame ranges; frame 0 starts the twin and is not scored.

    Attributes:
        train, test: ranges of the scored frames.
        edges: the training frames in blocks of neighbours, (B + 1,).
    """

    train: tuple[int, int]
    test: tuple[int, int]
    edges: Array

    @property
    def blocks(self) -> int:
        """B."""
        return len(self.edges) - 1

    def block_of(self, frames: Array) -> Array:
        """Block of every frame."""
        return np.searchsorted(self.edges, frames, side="right") - 1


def freeze(scene: Scene, blocks: int, shortest: int) -> Split:
    """The split of a scene, with ``blocks`` blocks at most, none shorter than ``shortest`` frames."""
    first, test = max(scene.train[0], 1), held_out_frames(scene)
    end = scene.train[1] if _declares_split(scene) else test[0]
    count = int(np.clip((end - first) // shortest, 1, blocks))
    return Split((first, end), test, np.linspace(first, end, count + 1).round().astype(int))


def held_out_frames(scene: Scene) -> tuple[int, int]:
    """The half-open range of frames of a scene that no inference looks at."""
    if _declares_split(scene):
        return scene.test
    end = max(max(scene.train[0], 1) + 1, round((1.0 - HELD_OUT_SHARE) * scene.frame_count))
    return (end, scene.frame_count)


def _declares_split(scene: Scene) -> bool:
    return scene.test[1] > scene.test[0] >= scene.train[1]


def noise_sigma(scene: Scene, split: Split, tracks: Array) -> float | None:
    """Deviation per axis [m]; None where too few points were seen in four training frames in a row.

    Args:
        tracks: a prediction over the training frames at least, (frames, N, 3).
    """
    if scene.noise_sigma_m:
        return scene.noise_sigma_m
    window = slice(0, split.train[1])
    error = scene.points[window] - tracks[window]
    seen = scene.visible[window]
    third = error[3:] - 3 * error[2:-1] + 3 * error[1:-2] - error[:-3]
    row = seen[3:] & seen[2:-1] & seen[1:-2] & seen[:-3]
    if row.sum() < _FEWEST:
        return None
    found = float(np.median(np.abs(third[row])) / (_MEDIAN_OF_NORMAL * np.sqrt(_THIRD)))
    return found if found > 0 else None
