"""Arrays on the wire: nested lists for people, or base64 of little-endian float32 for everything longer.

NumPy is imported where it is used: processes that pass requests on (supervisor, dispatcher) start without it.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema

if TYPE_CHECKING:
    import numpy as np

FARTHEST_M = 1000.0
"""No place is farther from the origin, along an axis [m]: beyond, single precision is coarser than 0.06 mm."""
MAX_LISTED_VALUES = 41_000
"""Values that one request may list as JSON; arrays of more are sent as base64."""
PIECE_BYTES = 3 * 2**18
"""Base64 is written and read in pieces: one call would hold the interpreter for the whole array."""

Side = Annotated[int, Field(ge=0, lt=2**31)]


def _listed(axes: int) -> dict[str, Any]:
    """JSON schema of a list of lists of numbers."""
    return {"type": "array", "items": {"type": "number"} if axes == 1 else _listed(axes - 1)}


Nested = Annotated[
    list[Any],
    WithJsonSchema(
        {"anyOf": [_listed(axes) for axes in (2, 3, 4)], "description": "Values as lists of lists."}
    ),
]


class EncodedArray(BaseModel):
    """``data`` is base64 of the values in C order, ``dtype`` always ``<f4``: little-endian float32."""

    model_config = ConfigDict(extra="forbid")

    shape: list[Side] = Field(max_length=6, description="Sizes of the axes.", examples=[[2, 3]])
    dtype: Literal["<f4"] = Field(default="<f4", description="Type of the values: little-endian float32.")
    data: str = Field(description="Values in C order, base64.")

    @classmethod
    def of(cls, values: np.ndarray) -> EncodedArray:
        """The array in single precision. Raises ValueError for a finite value that it does not hold."""
        import numpy as np

        given = np.asarray(values)
        with np.errstate(over="ignore"):
            plain = np.ascontiguousarray(given, dtype="<f4")
        lost = np.isinf(plain) & np.isfinite(given)
        if lost.any():
            first = np.argwhere(lost)[0].tolist()
            raise ValueError(
                f"{given[tuple(first)]:.4g} at {first} is beyond single precision, {np.finfo('<f4').max:.4g}"
            )
        raw = plain.tobytes()
        pieces = (base64.b64encode(raw[at : at + PIECE_BYTES]) for at in range(0, len(raw), PIECE_BYTES))
        return cls(shape=list(plain.shape), data=b"".join(pieces).decode())

    def numpy(self) -> np.ndarray:
        """The values, float32 of ``shape``. Raises ValueError with both sizes when they do not fit."""
        import numpy as np

        step = PIECE_BYTES // 3 * 4
        raw = bytearray()
        try:
            for at in range(0, len(self.data), step):
                raw += base64.b64decode(self.data[at : at + step], validate=True)
        except ValueError as error:
            raise ValueError(f"data is not base64: {error}") from error
        expected = 4 * math.prod(self.shape)
        if len(raw) != expected:
            raise ValueError(f"data has {len(raw)} bytes; shape {self.shape} of <f4 needs {expected}")
        return np.frombuffer(raw, dtype="<f4").reshape(self.shape)


ArrayInput = EncodedArray | Nested


def single_values(value: Any) -> Iterator[Any]:
    """What a field of a body lists, whatever it is listed in; not by recursion, a body may be nested deeply."""
    waiting = [value]
    while waiting:
        part = waiting.pop()
        if isinstance(part, dict | list | tuple):
            waiting += part.values() if isinstance(part, dict) else part
        else:
            yield part


def array_of(
    value: ArrayInput, name: str, dimensions: tuple[int, ...], most: float | None = None
) -> np.ndarray:
    """The values as float64, finite, with one of the numbers of axes, none of them beyond ±``most``.

    Args:
        value: numbers in lists, or encoded.
        name: for messages.
        dimensions: the numbers of axes that it may have.
        most: largest absolute value; None allows any finite one.

    Raises:
        ValueError: ragged, empty, of other axes, not finite or beyond ``most``; the message has the numbers.
    """
    import numpy as np

    if isinstance(value, EncodedArray):
        values = value.numpy().astype(np.float64)
    else:
        try:
            if not all(type(item) in (int, float) for item in single_values(value)):
                raise TypeError
            values = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{name} is not a regular array of numbers") from error
    if values.ndim not in dimensions:
        raise ValueError(
            f"{name} has {values.ndim} axes (shape {values.shape}), not {' or '.join(map(str, dimensions))}"
        )
    if not values.size:
        raise ValueError(f"{name} of shape {values.shape} is empty")
    broken = values.size - int(np.isfinite(values).sum())
    if broken:
        first = np.argwhere(~np.isfinite(values))[0].tolist()
        raise ValueError(f"{name} holds {broken} values that are not finite, the first at {first}")
    largest = float(np.abs(values).max())
    if most is not None and largest > most:
        place = np.unravel_index(int(np.abs(values).argmax()), values.shape)
        raise ValueError(
            f"{name} reaches {largest:.4g} at {[int(i) for i in place]}; {most:g} is the farthest from 0"
        )
    return values
