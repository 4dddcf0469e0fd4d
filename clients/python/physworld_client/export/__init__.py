"""Episodes of a dataset written as other tools read them: plain npz, a PLY sequence, LeRobot v3.

A writer takes the episodes one by one, in the order of their index, so that only one of them is in memory:
``for index, arrays in …: writer.add(index, arrays)`` and at the end ``writer.finish()``.
A new format is a file beside this one and an entry of ``FORMATS``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Protocol

from physworld_client.errors import ExportRefused
from physworld_client.export.lerobot import LeRobotWriter
from physworld_client.export.npz import NpzWriter
from physworld_client.export.ply import PlyWriter
from physworld_client.types import Array
from physworld_schemas.dataset import Dataset

DATASET_FILE = "dataset.json"


class Writer(Protocol):
    """What every format has: a title and help for the catalogue, and how it takes a folder and a number of points.

    Files but ``unfinished`` are as they will be once an episode is added: whoever sends them on may take them away.
    """

    title: ClassVar[str]
    help: ClassVar[str]
    unfinished: Path | None

    def __init__(self, folder: Path, points: int | None = None) -> None: ...

    def add(self, index: int, arrays: Mapping[str, Array]) -> None:
        """Write one episode; ``arrays`` are those of ``datasets.episode``."""

    def finish(self) -> None:
        """Write what belongs to all episodes. Raises ExportRefused where none was added."""


FORMATS: dict[str, type[Writer]] = {"npz": NpzWriter, "ply": PlyWriter, "lerobot": LeRobotWriter}


def open_export(format: str, folder: str | Path, dataset: Dataset, points: int | None = None) -> Writer:
    """A writer into an empty or new folder; the dataset's facts are written there at once.

    Args:
        format: one of ``FORMATS``.
        points: at most so many particles, spread evenly over the body; None: all of them (npz always has all).

    Raises:
        ExportRefused: an unknown format, a folder that holds something, a dataset that is not sealed, a missing
            package.
    """
    if format not in FORMATS:
        raise ExportRefused(f"unknown format {format!r}; there are {', '.join(FORMATS)}")
    if points is not None and points < 1:
        raise ExportRefused(f"{points} points asked for; an episode needs at least one")
    if dataset.state != "sealed":
        raise ExportRefused(f"dataset {dataset.id} is {dataset.state}; only a sealed one is exported")
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ExportRefused(f"{target} exists and is not an empty folder")
    writer = FORMATS[format](target, points)
    target.mkdir(parents=True, exist_ok=True)
    text = json.dumps(dataset.model_dump(mode="json"), indent=1)
    (target / DATASET_FILE).write_text(text)
    return writer
