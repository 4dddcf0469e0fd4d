"""Child process of the imports that a library parses: C3D by ezc3d, HDF5 by h5py, MCAP by mcap, LeRobot's
episodes by pyarrow.

``python -m physworld_scenes.importers.library_child FORM SOURCE TARGET`` writes the arrays that it found to TARGET
(npz) and prints what else there is to say as JSON. Its memory is limited; it ends with status 1 and one line on
stderr when the file cannot be read.
"""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array

MEMORY_BYTES = 896 << 20
"""Of its own data: what a file of the allowed size needs, and less than a GiB."""

Content = tuple[dict[str, Array], dict[str, Any]]


def reader_of(form: str) -> Callable[[str], Content]:
    """What reads a form: from a file's path to arrays by name and facts; it raises ValueError and the library's."""
    if form == "c3d":
        from physworld_scenes.importers.c3d_content import content_of as c3d

        return c3d
    if form == "hdf5":
        from physworld_scenes.importers.tables.hdf5_content import content_of as hdf5

        return lambda source: (hdf5(source), {})
    if form == "mcap_poses":
        from physworld_scenes.importers.robot.mcap_poses import content_of as mcap_poses

        return mcap_poses
    if form == "lerobot":
        from physworld_scenes.importers.robot.lerobot_content import content_of as lerobot

        return lerobot
    from physworld_scenes.importers.tables.mcap_content import content_of as mcap

    return mcap


def main(form: str, source: str, target: str) -> int:
    """Parse ``source``; the arrays go to ``target``, the facts to standard output."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    try:
        arrays, facts = reader_of(form)(source)
        with Path(target).open("wb") as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]
        print(json.dumps(facts))
    except MemoryError:
        print(f"reading it takes more than {MEMORY_BYTES >> 20} MiB", file=sys.stderr)
        return 1
    except Exception as error:  # noqa: BLE001  whatever the library raises on a damaged file is one line
        print(" ".join(str(error).split())[:300] or type(error).__name__, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:4]))
