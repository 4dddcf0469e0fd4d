"""Arrays that the service answers with: npz without pickles."""

from __future__ import annotations

import io
import zipfile

import numpy as np

from physworld_client.errors import PhysWorldError
from physworld_client.types import Array


def arrays_of(data: bytes) -> dict[str, Array]:
    """The arrays of an npz by name.

    Raises:
        PhysWorldError: the bytes are no npz, or one that would have to be unpickled.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, OSError, zipfile.BadZipFile, AttributeError) as error:
        raise PhysWorldError(f"the service answered {len(data)} bytes that are no npz: {error}") from error
