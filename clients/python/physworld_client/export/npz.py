"""One npz an episode: the arrays as the service gives them, without pickles."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from physworld_client.errors import ExportRefused
from physworld_client.types import Array


class NpzWriter:
    """``episode-00000.npz`` and so on: ``times``, ``particles``, ``controllers``, ``properties``, ``attributes``."""

    title: ClassVar[str] = "one npz an episode"
    help: ClassVar[str] = "episode-00000.npz and so on: the arrays as the service gives them"

    def __init__(self, folder: Path, points: int | None = None) -> None:
        self._folder = folder
        self.unfinished: Path | None = None
        self._count = 0

    def add(self, index: int, arrays: Mapping[str, Array]) -> None:
        """Write one episode."""
        np.savez(self._folder / f"episode-{index:05d}.npz", allow_pickle=False, **arrays)
        self._count += 1

    def finish(self) -> None:
        """Nothing is left to write. Raises ExportRefused where no episode was added."""
        if not self._count:
            raise ExportRefused("the dataset holds no episode")
