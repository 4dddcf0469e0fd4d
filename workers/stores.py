"""What handlers read from and write to, opened once per process, with a small cache of decoded objects."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

from physworld_storage.artifacts import ArtifactStore
from physworld_storage.database import Database
from physworld_storage.episodes import EpisodeStore
from physworld_storage.scratch import ScratchStore
from physworld_storage.settings import Settings

Value = TypeVar("Value")
CACHE_ENTRIES = 4


class Stores:
    """Database, artifacts and episodes of one installation.

    Attributes:
        settings, database, artifacts, episodes, scratch: the opened stores.
    """

    def __init__(self, settings: Settings, database: Database) -> None:
        self.settings = settings
        self.database = database
        self.artifacts = ArtifactStore(settings)
        self.episodes = EpisodeStore(settings)
        self.scratch = ScratchStore(settings)
        self._cache: OrderedDict[Hashable, Any] = OrderedDict()

    def cached(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """``make()`` the first time, then the same object: for immutable things that many shards share."""
        if key in self._cache:
            self._cache.move_to_end(key)
        else:
            self._cache[key] = make()
            while len(self._cache) > CACHE_ENTRIES:
                self._cache.popitem(last=False)
        value: Value = self._cache[key]
        return value
