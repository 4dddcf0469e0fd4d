"""What hostile files left outside the data folder: listings before and after, compared."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.service.hostile_files.pieces import CANARY
from physworld_services.api.parsing import ROOT

UNWATCHED = frozenset(
    {".git", ".venv", "__pycache__", ".pytest_cache", ".mypy_cache", ".ruff_cache", ".import_linter_cache",
     ".hypothesis", "node_modules"}
)  # fmt: skip
"""Folders of tools, which write there whenever they like."""

Listing = dict[str, tuple[int, int]]


class Traces:
    """The state of all places but the data folder that belong to a run, and what has happened to them since.

    Watched with everything below: the data folder's parent, where the run keeps the service's temporary directory, and
    ``working``. Of the data folder, which the service itself fills, and of the top of places that others write to as
    well, only names that hold ``CANARY`` count.

    Args:
        data: the service's data folder.
        working: working directories of the service's processes; by default the web process's, which is this one's, and
            the parser processes'.
    """

    def __init__(self, data: Path, working: Sequence[Path] | None = None) -> None:
        self._data = data.resolve()
        chosen = (Path.cwd(), ROOT) if working is None else working
        self._places = sorted({self._data.parent, *(place.resolve() for place in chosen)})
        self._before = self._listing()

    def since(self) -> list[str]:
        """Paths that were made, changed or removed."""
        after = self._listing()
        return sorted(path for path in self._before | after if self._before.get(path) != after.get(path))

    def _listing(self) -> Listing:
        """Size in bytes and time of change in ns of each file, zeros for a folder."""
        found: Listing = {}
        for place in self._places:
            found.update(self._below(place))
        canaries = [*self._data.rglob(f"*{CANARY}*")]
        for place in (Path(tempfile.gettempdir()), Path("/tmp"), Path("/"), Path.home()):
            canaries += place.glob(f"*{CANARY}*")
        return found | {str(path): (0, 0) for path in canaries}

    def _below(self, place: Path) -> Iterator[tuple[str, tuple[int, int]]]:
        for folder, inner, files in os.walk(place):
            inner[:] = [name for name in inner if name not in UNWATCHED and Path(folder, name) != self._data]
            for name in inner:
                yield str(Path(folder, name)), (0, 0)
            for name in files:
                path = Path(folder, name)
                if not name.startswith(".coverage"):
                    told = path.lstat()
                    yield str(path), (told.st_size, told.st_mtime_ns)
