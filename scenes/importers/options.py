"""What an importer is, and what a person knows of a foreign recording that its file does not say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.scene import Scene
from physworld_scenes.declaration import Kind

TRAIN_FRACTION = 0.7
"""PhysTwin's split: train on frames [0, int(0.7 T)), hold out the rest."""

THIRD_DIFFERENCE_GAIN = 20.0
"""Variance of the third difference of white noise of unit variance: 1 + 9 + 9 + 1."""
GAUSSIAN_MAD = 0.6745
"""Median absolute value of a Gaussian of unit deviation."""


@dataclass(frozen=True)
class ImportOptions:
    """Facts that complete an import; None takes the importer's default.

    Attributes:
        name, kind: of the scene.
        importer: name of the form that reads the file; None: the content decides.
        fps: frame rate [Hz]; pictures and PhysTwin (30) take it where the file has none, tables of markers instead of
            the file's.
        noise_sigma_m: tracking noise per axis [m]; None estimates it.
        gravity_m_s2: in the scene's frame, z up.
        body: keys of ``scene.json``'s ``body``.
        controllers: tables of markers: names of the driven or clamped markers, of groups of them, or of rigid bodies;
            ('none',): there is none; None: guessed.
        markers: tables of markers: likewise of those on the body, in the order that they shall have; None: all others.
        up: the axis of the recording that points up, one of x, y, z, -x, -y, -z; None: guessed.
        unit: of a table of markers: m, cm, mm, in or ft; None: as the file says, or guessed.
        assume: whether facts of the body that nobody said stay open, with a warning; else a table of markers without
            them is refused.
    """

    name: str | None = None
    kind: Kind | None = None
    importer: str | None = None
    fps: float | None = None
    noise_sigma_m: float | None = None
    gravity_m_s2: tuple[float, float, float] = (0.0, 0.0, -9.81)
    body: dict[str, Any] = field(default_factory=dict)
    controllers: tuple[str, ...] | None = None
    markers: tuple[str, ...] | None = None
    up: str | None = None
    unit: str | None = None
    assume: bool = True


@dataclass(frozen=True)
class Importer:
    """A form of recording.

    Attributes:
        name, title: in the catalogue; a few words for people.
        suffixes: file names usually end with one of them.
        help: what of the file is read.
        recognises: whether the bytes of a file of that name are of this form; the first importer that says so reads it.
        read: bytes, the scene's name where the file has none, and options, to the scene and its warnings. Raises
            SceneInvalid, with every fault.
        look: likewise, to what would be guessed: what, value, how, the option that says otherwise; and lines of what is
            left out. None: of this form nothing is guessed.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    help: str
    recognises: Callable[[bytes, str], bool]
    read: Callable[[bytes, str, ImportOptions | None], tuple[Scene, list[str]]]
    look: (
        Callable[[bytes, str, ImportOptions | None], tuple[list[tuple[str, str, str, str]], list[str]]] | None
    ) = None


@dataclass(frozen=True)
class FolderImporter:
    """A form of recording that is a folder; the command ``physworld import`` reads it.

    Attributes:
        name, title: in the catalogue; a few words for people.
        suffixes: what the folder holds.
        help: what of it is read.
        recognises: whether a folder is of this form.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    help: str
    recognises: Callable[[Path], bool]


def split_of(frames: int) -> dict[str, list[int]]:
    """PhysTwin's split of T frames, at least one frame on either side."""
    last = min(max(int(TRAIN_FRACTION * frames), 1), frames - 1)
    return {"train": [0, last], "test": [last, frames]}


def estimate_noise(points: Array, visible: Array) -> float | None:
    """White noise per axis [m] from third differences; None if no point is seen in four frames running.

    Motion adds to it, so it is an upper estimate; the median keeps jumps out.

    Args:
        points: (T, N, 3) [m].
        visible: (T, N) bool.
    """
    if len(points) < 4:
        return None
    seen = visible[:-3] & visible[1:-2] & visible[2:-1] & visible[3:]
    third = np.abs(np.diff(points, n=3, axis=0)[seen])
    if not third.size:
        return None
    sigma = float(np.median(third)) / GAUSSIAN_MAD / THIRD_DIFFERENCE_GAIN**0.5
    return sigma if sigma > 0.0 else None
