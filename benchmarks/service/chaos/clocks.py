"""Wall clocks of processes of our own, moved while they run. Needs Linux and a C compiler."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).with_name("wall_clock.c")


def clock_library(folder: Path) -> Path | None:
    """The library that moves clocks, compiled into ``folder``; None where it cannot be had here."""
    library = folder / "wall_clock.so"
    if library.exists():
        return library
    compiler = shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        return None
    command = [compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(SOURCE)]
    return library if subprocess.run(command, capture_output=True, check=False).returncode == 0 else None


class Clock:
    """The wall clock of the processes that are started with its variables; monotonic clocks are left as they are."""

    def __init__(self, library: Path, file: Path) -> None:
        self._file = file
        file.write_bytes(bytes(8))
        self.variables = {"LD_PRELOAD": str(library), "CHAOS_CLOCK": str(file)}

    def step(self, seconds: float) -> None:
        """Set it so far from the true time [s], at once."""
        with self._file.open("r+b") as file:
            file.write(struct.pack("=q", round(seconds * 1e9)))
