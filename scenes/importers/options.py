"""What an importer is, and what a person knows of a foreign recording that its file does not say."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
class Looked:
    """What an import would guess.

    Attributes:
        guesses: what, value, how, and the option that says otherwise.
        lines: of what is left out, and what speaks against a guess.
        markers: name, roles (``body``, ``gripper``, both or none), whether it is a rigid body's pose, and place [m]
            in the scene's world, of each.
        axes: directions of the file's x, y and z in the scene's world, 3 × 3; without markers none.
    """

    guesses: tuple[tuple[str, str, str, str], ...] = ()
    lines: tuple[str, ...] = ()
    markers: tuple[tuple[str, tuple[str, ...], bool, tuple[float, float, float]], ...] = ()
    axes: tuple[tuple[float, float, float], ...] = ()


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
        look: likewise, to what would be guessed. None: of this form nothing is.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    help: str
    recognises: Callable[[bytes, str], bool]
    read: Callable[[bytes, str, ImportOptions | None], tuple[Scene, list[str]]]
    look: Callable[[bytes, str, ImportOptions | None], Looked] | None = None


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

    def third_differences() -> Iterator[Array]:
        for t in range(len(points) - 3):
            seen = visible[t : t + 4].all(axis=0)
            yield np.abs(np.diff(points[t : t + 4], n=3, axis=0)[0, seen]).ravel()

    middle = median_of(third_differences)
    if middle is None:
        return None
    sigma = middle / GAUSSIAN_MAD / THIRD_DIFFERENCE_GAIN**0.5
    return sigma if sigma > 0.0 else None


def median_of(blocks: Callable[[], Iterator[Array]]) -> float | None:
    """The median of numbers that are not negative and come in blocks, as ``np.median`` of all of them at once.

    The numbers are made twice and never held together: counted by their leading bits, whose order is theirs, and then
    sorted where the middle lies.

    Args:
        blocks: makes the blocks (n,), the same ones each time.

    Returns:
        The median, nan if a number is none; None without any.
    """
    counts = np.zeros(1 << 16, dtype=np.int64)
    for block in blocks():
        if np.isnan(block).any():
            return float("nan")
        counts += np.bincount(_leading_bits(block), minlength=len(counts))
    total = int(counts.sum())
    if not total:
        return None
    ranks = ((total - 1) // 2, total // 2)
    upto = np.cumsum(counts)
    first, last = (int(np.searchsorted(upto, rank, side="right")) for rank in ranks)
    chosen = []
    for block in blocks():
        leading = _leading_bits(block)
        chosen.append(block[(leading >= first) & (leading <= last)])
    near = np.sort(np.concatenate(chosen))
    before = int(upto[first] - counts[first])
    return float(np.mean([near[rank - before] for rank in ranks]))


def _leading_bits(numbers: Array) -> Array:
    """Of doubles that are not negative: the exponent and the first five bits of the fraction, (n,)."""
    bits = np.ascontiguousarray(numbers, dtype=np.float64).view(np.uint64) >> np.uint64(47)
    return bits.astype(np.int64)
