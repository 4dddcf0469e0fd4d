"""A cache of parsed recordings and arrays that is bounded by the bytes that it holds, not by their number."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from threading import Lock
from typing import Any, TypeVar

import numpy as np

Value = TypeVar("Value")


class ByteCache:
    """The values used last, together at most ``limit`` bytes; safe between threads.

    A value larger than that is never kept. Two threads that miss the same key at once both make it.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.bytes = 0
        self._held: OrderedDict[object, tuple[Any, int]] = OrderedDict()
        self._lock = Lock()

    def get(self, key: object, make: Callable[[], Value]) -> Value:
        """The value of ``key``, made where it is not held; what ``make`` raises is raised, and nothing is kept."""
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                held: Value = self._held[key][0]
                return held
        value = make()
        size = size_of(value)
        with self._lock:
            if key not in self._held and size <= self.limit:
                self._held[key] = (value, size)
                self.bytes += size
                while self.bytes > self.limit:
                    _, (_, least) = self._held.popitem(last=False)
                    self.bytes -= least
        return value


def size_of(value: object) -> int:
    """Bytes of a value and what it holds: arrays, containers, dataclasses, plain values."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    size = sys.getsizeof(value)
    if isinstance(value, Mapping):
        return size + sum(size_of(key) + size_of(item) for key, item in value.items())
    if isinstance(value, tuple | list | set | frozenset):
        return size + sum(map(size_of, value))
    if is_dataclass(value):
        return size + sum(size_of(getattr(value, field.name)) for field in fields(value))
    return size
