"""The frozen split: what a trace may look at, and the held-out frames that it may not.

The scene's own split where it declares one; else the last 30 % of the frames are held out. Nothing but
:mod:`physworld.trace.held_out` reads measurements of held-out frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.scene import Scene

HELD_OUT_SHARE = 0.3


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
    first, end = max(scene.train[0], 1), scene.train[1]
    test = scene.test
    if test[1] <= test[0] or test[0] < end:
        end = max(first + 1, round((1.0 - HELD_OUT_SHARE) * scene.frame_count))
        test = (end, scene.frame_count)
    count = int(np.clip((end - first) // shortest, 1, blocks))
    return Split((first, end), test, np.linspace(first, end, count + 1).round().astype(int))
