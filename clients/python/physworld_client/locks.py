"""Advisory locks on open files (``flock``): they hold between threads and processes and end with their holder.

Where the system or the file system has none (Windows, some network mounts) every lock is granted: nothing is then
protected against another process at the same moment.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


def try_lock(stream: IO[bytes]) -> bool:
    """Whether the file's lock could be had without waiting; it is let go when ``stream`` is closed."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of the file at ``path``, which is made where there is none; waits for it.

    Raises:
        OSError: the file cannot be made.
    """
    with path.open("ab") as stream:
        if fcntl is not None:
            with suppress(OSError):
                fcntl.flock(stream, fcntl.LOCK_EX)
        yield
