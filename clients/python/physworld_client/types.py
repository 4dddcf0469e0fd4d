"""The type of arrays in signatures.

Shapes and units stand in docstrings, since numpy's types know neither; the element type is named where it matters.
"""

from typing import Any, TypeAlias

import numpy.typing as npt

Array: TypeAlias = npt.NDArray[Any]
"""An array of any element type."""
