"""What a child process that reads strangers' files may take: limits that the kernel keeps (ADR 28).

The child has none of its parent's secrets in its environment (``PASSED_ON``), and ends with its parent.
"""

from __future__ import annotations

import dataclasses
import os
import resource
import signal
import sys
from pathlib import Path

from physworld_schemas.base import FieldError

MEBIBYTE = 1 << 20
MOST_FAULTS, FAULT_CHARACTERS = 50, 2000
PR_SET_PDEATHSIG = 1
PASSED_ON = ("PATH", "HOME", "TMPDIR", "LANG", "LC_ALL", "PYTHONPATH", "VIRTUAL_ENV", "LD_LIBRARY_PATH")
"""Of the environment: a reader of hostile files has no use for addresses and keys."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """What reading may take.

    Attributes:
        cpu_s: of a processor [s].
        wall_s: by the clock [s].
        memory_bytes: private memory beyond what the process has when they are imposed.
        output_bytes: of each file that it writes.
    """

    cpu_s: int
    wall_s: int
    memory_bytes: int
    output_bytes: int

    def impose(self) -> None:
        """Let the kernel end this process where it goes beyond them."""
        resource.setrlimit(resource.RLIMIT_CPU, (self.cpu_s, self.cpu_s + 1))
        resource.setrlimit(resource.RLIMIT_DATA, (_data_bytes() + self.memory_bytes,) * 2)
        resource.setrlimit(resource.RLIMIT_FSIZE, (self.output_bytes,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, self.wall_s)


def stopped_by(returncode: int) -> str:
    """The limit by which a signal ended a process: ``cpu``, ``wall``, ``killed``; else ``crashed``.

    Args:
        returncode: negative the signal, as ``subprocess`` has it.
    """
    named = {-signal.SIGXCPU: "cpu", -signal.SIGKILL: "killed", -signal.SIGALRM: "wall"}
    return named.get(returncode, "crashed")


def die_with_parent() -> None:
    """Let the kernel end this process when its parent ends."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def environment() -> dict[str, str]:
    """The environment of such a process: no secrets, one thread of each library."""
    passed = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
    return passed | {"OMP_NUM_THREADS": "1"}


def told(faults: list[FieldError]) -> list[dict[str, object]]:
    """Faults as JSON, no longer than somebody reads them."""
    return [
        {
            "loc": [part if isinstance(part, int) else part[:200] for part in fault.loc[:20]],
            "msg": fault.msg[:FAULT_CHARACTERS],
        }
        for fault in faults[:MOST_FAULTS]
    ]


def _data_bytes() -> int:
    """Private memory of this process now, as RLIMIT_DATA counts it."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmData:"):
            return int(line.split()[1]) * 1024
    return 0
