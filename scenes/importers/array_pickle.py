"""Reads a pickle that holds numbers in numpy arrays and plain containers, and nothing else.

A pickle is a program; here it can reach five names, and none of them is numpy's own code: stand-ins take the
state that numpy would be given, check it and build the array from bytes. Any other name that the pickle asks
for is refused by that name. The interpreter is the pure Python one: the C one allocates what a forged memo
index says. Large arrays are not copied out of the file's bytes: they are views of it, which nobody can write to.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld_schemas.wording import reason

NUMBER_CODE = re.compile(r"^([<>|=]?)([biuf])(1|2|4|8)$")
"""Type codes of numpy that are plain numbers."""

MALFORMED = (
    pickle.UnpicklingError,
    struct.error,
    EOFError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
    AssertionError,
    MemoryError,
)
"""What the interpreter raises on a truncated or forged stream."""


VIEWED_BYTES = 1 << 20
"""What is read at once and is at least as long is a view of the file."""


class PickleRefused(ValueError):
    """A pickle that is not just arrays; the message names what it wanted."""


def load_arrays(data: bytes) -> Any:
    """The object in the pickle: dicts, lists, tuples, strings, numbers and read-only numpy arrays of numbers.

    Raises:
        PickleRefused: it calls something, holds something else, or is damaged.
    """
    try:
        loaded = _ArrayUnpickler(_Content(data)).load()
        return _Unwrapping().of(loaded, depth=0)
    except PickleRefused:
        raise
    except MALFORMED as error:
        raise PickleRefused(
            f"the pickle of {len(data)} bytes is damaged or truncated ({reason(error)[:200]})"
        ) from error


class _Content(io.BytesIO):
    """The file, which gives views of its bytes where much is read."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self._view = memoryview(data)

    def read(self, size: int | None = -1, /) -> Any:
        """As of any file, or a view."""
        if size is None or size < VIEWED_BYTES:
            return super().read(size)
        start = self.tell()
        found = self._view[start : start + size]
        self.seek(start + len(found))
        return found


class _Dtype:
    """Stands for ``numpy.dtype``."""

    def __init__(self, code: str, *_flags: object) -> None:
        if not isinstance(code, str) or not NUMBER_CODE.match(code):
            raise PickleRefused(f"holds an array of type {str(code)[:40]!r}; only numbers are read")
        self.code = code.lstrip("<>|=")
        self.order = "<"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        order, subtype, names, fields = state[1:5]
        if order not in ("<", ">", "|", "=") or any(part is not None for part in (subtype, names, fields)):
            raise PickleRefused("holds an array of a structured type; only numbers are read")
        self.order = order

    def numpy(self) -> np.dtype[Any]:
        """The type itself."""
        return np.dtype(self.order + self.code)


class _Array:
    """Stands for ``numpy.ndarray``."""

    def __init__(self, *_empty: object) -> None:
        self.value: Array | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _version, shape, dtype, fortran, content = state
        self.value = _build(shape, dtype, "F" if fortran else "C", content)


class _Callable:
    """A name that the pickle may call; its state cannot be touched."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *args: object) -> Any:
        return self._function(*args)

    def __setstate__(self, state: object) -> None:
        raise PickleRefused("tries to change a function")


def _build(shape: Any, dtype: Any, order: str, content: Any) -> Array:
    if not isinstance(dtype, _Dtype) or not isinstance(content, bytes | bytearray | memoryview):
        raise PickleRefused("holds an array of Python objects; only numbers are read")
    if not isinstance(shape, tuple) or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise PickleRefused(f"holds an array of shape {str(shape)[:80]}")
    kind = dtype.numpy()
    if math.prod(shape) * kind.itemsize != len(content):
        raise PickleRefused(
            f"holds an array that claims shape {shape} of {kind} and has {len(content)} bytes"
        )
    own = bytes(content) if isinstance(content, bytearray) else content
    return np.frombuffer(own, dtype=kind).reshape(shape, order="F" if order == "F" else "C")


def _empty_array(kind: Any, *_placeholder: object) -> _Array:
    if kind is not _Array:
        raise PickleRefused("reconstructs something that is not an array")
    return _Array()


def _from_buffer(content: Any, dtype: Any, shape: Any, order: str, *_axes: object) -> _Array:
    array = _Array()
    array.value = _build(shape, dtype, order, content)
    return array


def _scalar(dtype: Any, content: Any) -> _Array:
    array = _Array()
    array.value = _build((), dtype, "C", content)
    return array


class _ArrayUnpickler(pickle._Unpickler):
    """Finds the names that numpy writes for an array, and their stand-ins."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numpy", "ndarray"):
            return _Array
        if (module, name) == ("numpy", "dtype"):
            return _Dtype
        functions: dict[tuple[str, str], Callable[..., Any]] = {
            ("multiarray", "_reconstruct"): _empty_array,
            ("multiarray", "scalar"): _scalar,
            ("numeric", "_frombuffer"): _from_buffer,
        }
        package, _, part = module.rpartition(".")
        if package in ("numpy.core", "numpy._core") and (part, name) in functions:
            return _Callable(functions[part, name])
        raise PickleRefused(f"wants {module}.{name}; only numpy arrays and plain containers are read")

    def persistent_load(self, pid: object) -> Any:
        raise PickleRefused("refers to an object outside the file")


MAX_DEPTH = 8
MAX_ITEMS = 1_000_000
"""Of all containers together, each counted as often as it is met: lists that share a child are small only on disk."""


class _Unwrapping:
    """Containers with the arrays themselves in the stand-ins' places."""

    def __init__(self) -> None:
        self._left = MAX_ITEMS

    def of(self, value: Any, depth: int) -> Any:
        """The value without stand-ins."""
        if depth > MAX_DEPTH:
            raise PickleRefused(f"nests deeper than {MAX_DEPTH} levels")
        if isinstance(value, _Array):
            if value.value is None:
                raise PickleRefused("holds an array without content")
            return value.value
        if isinstance(value, dict | list | tuple):
            self._left -= len(value)
            if self._left < 0:
                raise PickleRefused(f"holds more than {MAX_ITEMS} items, which is the most that is read")
        if isinstance(value, dict):
            return {_plain(key): self.of(item, depth + 1) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [self.of(item, depth + 1) for item in value]
        return _plain(value)


def _plain(value: Any) -> Any:
    if isinstance(value, memoryview):
        return bytes(value)
    if value is None or isinstance(value, str | bytes | bool | int | float):
        return value
    raise PickleRefused(
        f"holds a {type(value).__name__.lstrip('_')}; only arrays and plain containers are read"
    )
