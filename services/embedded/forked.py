"""A Python program as a fork of the supervisor, not a new interpreter: what several parts import is imported once.

Most of the CPU time of a start goes into imports, and most of these are the same in the dispatcher, the workers, the
trainer and the web process. The supervisor imports them before it starts the first child; it is one thread, holds no
connection and nothing that computes (NumPy, torch and Warp set up threads when they are loaded, so a child loads them
itself). From there a child is as ``python -m`` would make it: a session, an environment, a log and signals of its own,
no file of the supervisor's that it was not given, and an end that runs nothing of the supervisor's. Linux only.
"""

from __future__ import annotations

import atexit
import ctypes
import importlib
import os
import random
import runpy
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

AVAILABLE = sys.platform == "linux"
SHARED = (
    "celery.apps.worker",
    "celery.concurrency.prefork",
    "celery.worker.consumer",
    "kombu.transport.redis",
    "physworld_storage.changes",
    "physworld_storage.idempotency",
    "physworld_storage.jobs.leases",
    "physworld_storage.scratch",
    "physworld_workers.app",
)
"""What children have in common."""
POLL_S = 0.02
PR_SET_PDEATHSIG, PR_SET_NAME = 1, 15


def import_shared() -> None:
    """Import what children have in common, before the first of them that needs it is started."""
    if AVAILABLE:
        for name in SHARED:
            importlib.import_module(name)


class Forked:
    """A running program; the part of ``subprocess.Popen`` that a supervisor uses.

    Args:
        name: of the process, in lists of processes.
        module: whose ``main`` runs.
        arguments: on its command line.
        environment: all its variables.
        output: descriptor that standard output and error are written to.
        descriptors: that stay open in it; all others are closed.
    """

    def __init__(
        self,
        name: str,
        module: str,
        arguments: Sequence[str],
        environment: Mapping[str, str],
        output: int,
        descriptors: Collection[int],
    ) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        self.returncode: int | None = None
        parent = os.getpid()
        self.pid = os.fork()
        if self.pid == 0:
            code = 1
            try:
                _leave(parent, name, environment, output, descriptors)
                code = _run(module, arguments)
            except BaseException:  # noqa: BLE001 - nothing of the supervisor's may run after this
                traceback.print_exc()
            finally:
                os._exit(code)

    def poll(self) -> int | None:
        """The exit code once it has ended, minus the signal that ended it."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if deadline is not None and time.monotonic() >= deadline:
                raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
            time.sleep(POLL_S)
        return code

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal, if it runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it now."""
        self.send_signal(signal.SIGKILL)


def _leave(
    parent: int, name: str, environment: Mapping[str, str], output: int, descriptors: Collection[int]
) -> None:
    """In the child: nothing of the supervisor's stays."""
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.setsid()
    library = ctypes.CDLL(None, use_errno=True)
    library.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    library.prctl(PR_SET_NAME, name.encode())
    nothing = os.open(os.devnull, os.O_RDONLY)
    for source, target in ((nothing, 0), (output, 1), (output, 2)):
        os.dup2(source, target)
    sys.stdin = os.fdopen(0, closefd=False)
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    kept = {0, 1, 2, *descriptors}
    for entry in list(Path("/proc/self/fd").iterdir()):
        if int(entry.name) not in kept:
            try:
                os.close(int(entry.name))
            except OSError:
                continue  # the listing's own
    for descriptor in descriptors:
        os.set_inheritable(descriptor, True)
    os.environ.clear()
    os.environ.update(environment)
    random.seed()


def _run(module: str, arguments: Sequence[str]) -> int:
    """What ``python -m MODULE ARGUMENTS`` does, to its end; the exit code."""
    sys.argv = [module, *arguments]
    code: object = 0
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as error:
        code = error.code
    except BaseException:  # noqa: BLE001 - it ends here, as an interpreter would
        traceback.print_exc()
        code = 1
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    if isinstance(code, int):
        return code & 0xFF
    if code is not None:
        print(code, file=sys.stderr, flush=True)
    return 0 if code is None else 1
