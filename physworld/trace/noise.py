"""Tracking noise: declared, or what is left of the measured tracks when everything smooth is taken out.

The third difference over frames of measured minus predicted has 20 times the variance of white noise, while a motion
that the frame rate resolves leaves little; the median over all of them is not moved by the few places where it does.
Uneven frame times are fine as long as they are nearly even.
"""

from __future__ import annotations

import numpy as np

from physworld.scene import Scene
from physworld.trace.split import Split

_THIRD = 20.0  # sum of squares of 1, -3, 3, -1
_MEDIAN_OF_NORMAL = 0.6745
_FEWEST = 30


def noise_sigma(scene: Scene, split: Split, tracks: np.ndarray) -> float | None:
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
