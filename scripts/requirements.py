"""Print the locked requirements of the named extras with their digests, for ``pip install --no-deps --require-hashes``.

``python scripts/requirements.py api sim`` prints all that the distribution with the extras *api* and *sim* needs:
``requirements.lock`` names for each package the extras that need it, directly or not. *torch* is an extra of the lock
alone: the CPU build, whose packages are among those of *train*. *bootstrap* is what makes an environment where Python
has no ensurepip.
"""

from __future__ import annotations

import sys
from pathlib import Path

LOCK = "requirements.lock"
BASE = "base"  # what the two distributions need without any extra
ALONE = {"torch", "bootstrap"}  # asked for without them


def locked(lock: Path) -> dict[str, tuple[set[str], str]]:
    """For each requirement of the lock (``name==version`` with its marker) the extras that need it, and its text."""
    found: dict[str, tuple[set[str], str]] = {}
    extras: set[str] = set()
    name = ""
    for line in lock.read_text().splitlines(keepends=True):
        if line.startswith("#"):
            extras, name = set(line[1:].split()), ""
        elif not line.startswith(" "):
            name = line.rstrip("\\\n").strip()
            found[name] = (extras, line)
        else:
            found[name] = (found[name][0], found[name][1] + line)
    return found


def needed(lock: Path, extras: list[str]) -> str:
    """The entries of the lock that these extras need. Raises KeyError for an extra that the lock does not name."""
    entries = locked(lock)
    known = set().union(*(named for named, _ in entries.values()))
    for extra in extras:
        if extra not in known:
            raise KeyError(f"{extra!r} is no extra of {lock}; known: {', '.join(sorted(known))}")
    wanted = set(extras) if ALONE.issuperset(extras) else {*extras, BASE}
    return "".join(text for named, text in entries.values() if named & wanted)


if __name__ == "__main__":
    here = Path(__file__).resolve().parent
    lock = next(folder / LOCK for folder in (here, here.parent) if (folder / LOCK).is_file())
    sys.stdout.write(needed(lock, sys.argv[1:]))
