"""Tracking noise: declared, or what is left of the measured tracks when everything smooth is taken out.

The third difference over frames of measured minus predicted has 20 times the variance of white noise, while a motion
that the frame rate resolves leaves little; the median over all of them is not moved by the few places where it does.
Uneven frame times are fine as long as they are nearly even.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from physworld.scene import Scene

_THIRD = 20.0  # sum of squares of 1, -3, 3, -1
_MEDIAN_OF_NORMAL = 0.6745
_FEWEST = 30
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
    return [replace(scene, noise_sigma_m=noise_m) for scene in scenes]


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
