"""Arrays in npz without pickles: those that the service answers with, and those of local files."""

from __future__ import annotations

import io
import zipfile

import numpy as np

from physworld_client.errors import PhysWorldError
from physworld_client.types import Array


def arrays_of(data: bytes, source: str = "the service's answer") -> dict[str, Array]:
    """The arrays of an npz by name.

    Args:
        data: the npz.
        source: what an error calls it.

    Raises:
        PhysWorldError: the bytes are no npz, or one that would have to be unpickled.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        raise PhysWorldError(f"{source}, {len(data)} bytes, is no npz of plain arrays: {error}") from error
