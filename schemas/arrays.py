"""Arrays on the wire: nested lists for people, or base64 of little-endian float32 for everything longer."""

from __future__ import annotations

import base64
import binascii
import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

Side = Annotated[int, Field(ge=0, lt=2**31)]
Nested = list[Any]


class EncodedArray(BaseModel):
    """``data`` is base64 of the values in C order, ``dtype`` always ``<f4``: little-endian float32."""

    model_config = ConfigDict(extra="forbid")

    shape: list[Side] = Field(max_length=6)
    dtype: Literal["<f4"] = "<f4"
    data: str

    @classmethod
    def of(cls, values: np.ndarray) -> EncodedArray:
        """The array in single precision."""
        plain = np.ascontiguousarray(values, dtype="<f4")
        return cls(shape=list(plain.shape), data=base64.b64encode(plain.tobytes()).decode())

    def numpy(self) -> np.ndarray:
        """The values, float32 of ``shape``. Raises ValueError with both sizes when they do not fit."""
        try:
            raw = base64.b64decode(self.data, validate=True)
        except binascii.Error as error:
            raise ValueError(f"data is not base64: {error}") from error
        expected = 4 * math.prod(self.shape)
        if len(raw) != expected:
            raise ValueError(f"data has {len(raw)} bytes; shape {self.shape} of <f4 needs {expected}")
        return np.frombuffer(raw, dtype="<f4").reshape(self.shape)


ArrayInput = EncodedArray | Nested


def array_of(value: ArrayInput, name: str, dimensions: tuple[int, ...]) -> np.ndarray:
    """The values as float64, finite, with one of the numbers of axes. Raises ValueError that says what is wrong."""
    if isinstance(value, EncodedArray):
        values = value.numpy().astype(np.float64)
    else:
        try:
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
    return values
