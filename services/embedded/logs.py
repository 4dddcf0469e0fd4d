"""Children's log files: appended to, and cut when they grow, with three older ones kept.

Children hold their file open in append mode, so a file is cut by copying it and truncating the original:
what they write next lands at its new end. Lines written between the copy and the cut are lost; logs may
lose lines.
"""

from __future__ import annotations

import shutil
from pathlib import Path

MAX_BYTES = 10 * 2**20
KEPT = 3
TAIL_BYTES = 4000


def rotate(path: Path, max_bytes: int = MAX_BYTES) -> bool:
    """Cut ``path`` if it is longer than ``max_bytes``; True if it was.

    Raises OSError where there is no room for the copy; nothing is lost then.
    """
    if not path.exists() or path.stat().st_size <= max_bytes:
        return False
    copy = path.with_suffix(".log.0")
    try:
        shutil.copyfile(path, copy)
    except OSError:
        copy.unlink(missing_ok=True)
        raise
    for age in range(KEPT, 1, -1):
        older = path.with_suffix(f".log.{age - 1}")
        if older.exists():
            older.replace(path.with_suffix(f".log.{age}"))
    copy.replace(path.with_suffix(".log.1"))
    with path.open("r+b") as file:
        file.truncate(0)
    return True


def tail(path: Path, lines: int = 15) -> str:
    """The last lines of a log, for a message about a child that did not start."""
    if not path.exists():
        return ""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - TAIL_BYTES))
        text = file.read().decode(errors="replace")
    return "\n".join(text.splitlines()[-lines:])
