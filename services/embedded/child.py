"""One child process: started to die with the supervisor, watched, and started again with growing pauses."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from physworld_services.embedded import forked, logs
from physworld_services.embedded.forked import PR_SET_PDEATHSIG, Forked

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 30.0
STEADY_S = 60.0
"""A child that ran this long starts again with the first pause."""


@dataclass(frozen=True)
class Program:
    """What to run.

    Attributes:
        name: of the child and of its log file.
        command: argument vector.
        environment: the child's whole environment.
        stop_signal: what asks it to end at once without losing anything.
        descriptors: open files that it inherits besides the family lock.
        ready_file: a file that it writes once it serves; None if something else tells.
        module: of a Python program whose command is ``python -m MODULE …``, which may be forked instead.
    """

    name: str
    command: Sequence[str]
    environment: Mapping[str, str]
    stop_signal: signal.Signals = signal.SIGTERM
    descriptors: tuple[int, ...] = ()
    ready_file: Path | None = None
    module: str = ""


@dataclass
class Child:
    """A program with its process; ``watch`` starts it whenever it is due."""

    program: Program
    log: Path
    family_descriptor: int
    process: subprocess.Popen[bytes] | Forked | None = None
    exits: int = 0
    last_exit: int | None = None
    _started_at: float = 0.0
    _due_at: float = field(default=0.0)
    _quick_exits: int = 0

    @property
    def pid(self) -> int | None:
        """The process id while it runs."""
        return self.process.pid if self.process is not None else None

    def watch(self) -> bool:
        """Notice an exit, start when due; True if the set of processes changed.

        Raises OSError for a start that failed; the next one is due after the longest pause.
        """
        changed = self._reap()
        if self.process is None and time.monotonic() >= self._due_at:
            self._due_at = time.monotonic() + LONGEST_PAUSE_S
            self.start()
            changed = True
        return changed

    def start(self) -> None:
        """Start it now."""
        with suppress(OSError):  # of a full disk: a log that is too long keeps nobody from running
            logs.rotate(self.log)
        if self.program.ready_file is not None:
            self.program.ready_file.unlink(missing_ok=True)
        program, descriptors = self.program, (self.family_descriptor, *self.program.descriptors)
        with self.log.open("ab") as output:
            if program.module and forked.AVAILABLE:
                self.process = Forked(
                    program.name,
                    program.module,
                    program.command[3:],
                    program.environment,
                    output.fileno(),
                    descriptors,
                )
            else:
                self.process = subprocess.Popen(
                    list(program.command),
                    env=dict(program.environment),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    pass_fds=descriptors,
                    start_new_session=True,
                    preexec_fn=_death_with_parent(os.getpid()),
                )
        self._started_at = time.monotonic()

    def ask_to_stop(self) -> None:
        """Send the stop signal, if it runs."""
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(self.program.stop_signal)

    def wait_or_kill(self, deadline: float) -> bool:
        """Wait until ``deadline`` (monotonic), then kill its whole session; True if it ended by itself."""
        if self.process is None:
            return True
        ended = True
        try:
            self.process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            ended = False
        self._kill_session()
        self.process.kill()  # one that was forked a moment ago has no session of its own yet
        self.process.wait()
        self.process = None
        return ended

    def _reap(self) -> bool:
        if self.process is None or self.process.poll() is None:
            return False
        self._kill_session()  # pool processes that a killed worker left behind
        lasted_s = time.monotonic() - self._started_at
        self._quick_exits = 1 if lasted_s >= STEADY_S else self._quick_exits + 1
        pause_s = min(FIRST_PAUSE_S * 2 ** (self._quick_exits - 1), LONGEST_PAUSE_S)
        self._due_at = time.monotonic() + pause_s
        self.last_exit = self.process.returncode
        self.exits += 1
        self.process = None
        return True

    def _kill_session(self) -> None:
        if self.process is not None:
            try:
                os.killpg(self.process.pid, signal.SIGKILL)
            except ProcessLookupError:
                return


def _death_with_parent(parent: int) -> Callable[[], None] | None:
    """What the child does before it becomes the program: ask the kernel to end it with its parent (Linux)."""
    if sys.platform != "linux":
        return None
    library = ctypes.CDLL(None, use_errno=True)

    def ask() -> None:
        library.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)

    return ask
