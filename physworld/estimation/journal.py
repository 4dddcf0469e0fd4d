"""Resume of a calibration: the finished steps of its search, small enough to be stored after each of them.

The search is deterministic, so its way is fixed by what each step found (an optimum, a screening, a shift): a step
that an earlier attempt finished is read instead of simulated, and the resumed calibration ends where the
uninterrupted one would have. Entries are plain JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

_VERSION = 2  # an entry of a search says whether the budget cut it short
JOURNAL_BEGINS = '{"version": '
"""First characters of a stored journal."""


class Journal:
    """Steps in the order of the search.

    Args:
        key: what the steps belong to (scene, settings); a stored journal of another key is ignored.
        stored: what ``save`` was given last by an earlier attempt, or None.
        save: called with the whole journal as JSON text after every new step, or None.
    """

    def __init__(
        self, key: str = "", stored: str | None = None, save: Callable[[str], None] | None = None
    ) -> None:
        self._key, self._save, self._cursor = key, save, 0
        self._entries: list[dict[str, Any]] = _entries_of(stored, key)

    def step(self, name: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What the step called ``name`` found, read from the journal or computed and written there.

        An entry of another name means that the way has changed (another version of the code): the rest is dropped.
        """
        found: dict[str, Any]
        if self._cursor < len(self._entries) and self._entries[self._cursor]["name"] == name:
            found = self._entries[self._cursor]["found"]
        else:
            del self._entries[self._cursor :]
            found = _finite(compute())
            self._entries.append({"name": name, "found": found})
            if self._save is not None:
                self._save(json.dumps({"version": _VERSION, "key": self._key, "entries": self._entries}))
        self._cursor += 1
        return found


def _entries_of(stored: str | None, key: str) -> list[dict[str, Any]]:
    if stored is None:
        return []
    try:
        journal = json.loads(stored)
    except json.JSONDecodeError:  # cut off by a kill
        return []
    if not isinstance(journal, dict) or (journal.get("version"), journal.get("key")) != (_VERSION, key):
        return []
    return list(journal["entries"])


def _finite(value: Any) -> Any:
    """JSON has no infinity: numbers that are not finite become None."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
