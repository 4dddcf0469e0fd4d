"""Who holds a lease: a name for this process that no later process can take over.

``host/pid namespace/pid/start ticks``: the same pid on another host, in another container or after a restart
is another owner, so a lease whose owner is provably dead can be taken back without waiting for it to expire.
"""

from __future__ import annotations

import os
import socket
from pathlib import Path

_PROC = Path("/proc")


def process_owner() -> str:
    """The name of the calling process, e.g. ``lab3/4026531836/812/99120``."""
    pid = os.getpid()
    return f"{_place()}/{pid}/{_start_ticks(pid)}"


def owner_is_gone(owner: str) -> bool:
    """True only if the owner lived on this host, in this pid namespace, and no longer does."""
    place, _, rest = owner.rpartition("/")
    place, _, pid_text = place.rpartition("/")
    if place != _place() or not pid_text.isdigit():
        return False
    pid = int(pid_text)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return _start_ticks(pid) != rest or _is_zombie(pid)


def _place() -> str:
    try:
        namespace = str(Path("/proc/self/ns/pid").readlink()).strip("pid:[]")
    except OSError:
        namespace = "0"
    return f"{socket.gethostname()}/{namespace}"


def _stat_fields(pid: int) -> list[str]:
    """Fields of /proc/PID/stat from the third on (state first); empty where there is no /proc."""
    try:
        text = (_PROC / str(pid) / "stat").read_text()
    except OSError:
        return []
    return text.rpartition(")")[2].split()


def _start_ticks(pid: int) -> str:
    fields = _stat_fields(pid)
    return fields[19] if len(fields) > 19 else "0"


def _is_zombie(pid: int) -> bool:
    fields = _stat_fields(pid)
    return bool(fields) and fields[0] in {"Z", "X"}
