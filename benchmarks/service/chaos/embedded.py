"""The embedded service under chaos: one supervisor with its children on a data folder.

Where this process may mount (root), the data folder is a small file system in memory that can be filled, and its store
is mounted once more so that it can be made read-only. Where it may not, a full disk is played by a limit on the size
of files (``RLIMIT_FSIZE``) and a read-only store by the modes of its folders; root, whom modes do not bind, skips that.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from benchmarks.service.chaos import processes
from benchmarks.service.chaos.clocks import Clock, clock_library
from benchmarks.service.chaos.plan import Fault
from benchmarks.service.chaos.processes import CannotRun
from physworld_storage.settings import Settings

DISK_BYTES = 2 << 30
START_WITHIN_S, END_WITHIN_S, REMOUNT_WITHIN_S = 120.0, 40.0, 3.0
START_AGAIN_S = 0.5
BALLAST = "ballast"


class Embedded:
    """``python -m physworld_services.embedded`` in ``folder``; what keeps it running is ``mend``, as a service manager
    would."""

    kill_targets = ("worker", "pool", "dispatcher", "web", "broker", "trainer", "trainer_pool", "supervisor")
    lasting = (
        ("stop", "worker"), ("stop", "pool"), ("stop", "trainer_pool"), ("stop", "dispatcher"), ("stop", "web"),
        ("stop", "broker"), ("stop", "supervisor"), ("clock", "all"), ("disk_full", "all"), ("read_only", "all"),
    )  # fmt: skip

    def __init__(self, folder: Path, lease_s: float, orphan_s: float, workers: int = 2) -> None:
        self.folder, self.data = folder, folder / "data"
        self.starts = 0
        self._workers = [f"worker-{number}" for number in range(1, workers + 1)]
        self._process: subprocess.Popen[bytes] | None = None
        self._ended_at = 0.0
        self._mounted: list[Path] = []
        self._clock: Clock | None = None
        self._variables = {
            "PHYSWORLD_LEASE_SECONDS": f"{lease_s:g}",
            "PHYSWORLD_ORPHAN_SECONDS": f"{orphan_s:g}",
        }

    def start(self) -> None:
        """Make the folder, start the service, and wait until it serves."""
        self.data.mkdir(mode=0o700)
        self._mount()
        if (library := clock_library(self.folder)) is not None:
            self._clock = Clock(library, self.folder / "clock")
            self._variables |= self._clock.variables
        self._start()
        processes.until(
            self.ready, f"the service does not start, see {self.output}; it is ready", START_WITHIN_S
        )

    @property
    def output(self) -> Path:
        """What the supervisor prints."""
        return self.folder / "service.out"

    @property
    def url(self) -> str:
        """Of the API; the same after every start."""
        return str(self._state()["api_url"])

    @property
    def token(self) -> str:
        """The administrator's key."""
        return (self.data / "api-key").read_text().strip()

    def settings(self) -> Settings:
        """Of somebody who looks at database and store from outside."""
        return Settings(data_dir=self.data)

    def ready(self) -> bool:
        """Whether this start of the supervisor serves."""
        state = self._state()
        running = self._process is not None and self._process.poll() is None
        return running and state.get("pid") == self._process.pid and bool(state.get("ready"))

    def mend(self) -> None:
        """Start the service again when it has ended."""
        if self._process is not None and self._process.poll() is not None:
            if not self._ended_at:
                self._ended_at = time.monotonic()
            elif time.monotonic() - self._ended_at > START_AGAIN_S:
                self._start()

    def kill(self, fault: Fault) -> bool:
        """SIGKILL of the fault's target; False where it does not run now."""
        return processes.kill(self._find(fault))

    def begin(self, fault: Fault) -> Callable[[], None] | None:
        """Begin a fault that lasts; what ends it, None where it cannot be had here."""
        if fault.kind == "stop":
            return processes.stop(self._find(fault))
        if fault.kind == "clock" and self._clock is not None:
            self._clock.step(fault.step_s)
            return lambda: self._clock.step(0.0)
        if fault.kind == "disk_full":
            return self._fill() if self._mounted else self._limit_files()
        if fault.kind == "read_only":
            return self._remount() if self._mounted else self._close_folders()
        return None

    def possible(self, fault: Fault) -> bool:
        """Whether this machine can play such a fault at all."""
        if fault.kind == "clock":
            return self._clock is not None
        return fault.kind != "read_only" or bool(self._mounted) or os.geteuid() != 0

    def tidy(self) -> None:
        """Let the dispatcher do at once what it does every five minutes: it does so at its start."""
        if (dispatcher := self._child("dispatcher")) is not None:
            dispatcher.terminate()

    def end(self) -> None:
        """Stop the service; logs stay in the folder."""
        processes.end(self._process, signal.SIGTERM, END_WITHIN_S)
        if self.data.is_dir():
            subprocess.run(["cp", "-r", str(self.data / "logs"), str(self.folder / "logs")], check=False)
        for place in reversed(self._mounted):
            subprocess.run(["umount", "--lazy", str(place)], check=False)

    def _start(self) -> None:
        self._ended_at = 0.0
        self.starts += 1
        command = (
            sys.executable, "-m", "physworld_services.embedded", "--data", str(self.data), "--no-inference",
            "--workers", str(len(self._workers)),
        )  # fmt: skip
        self._process = processes.start(command, processes.environment(**self._variables), self.output)

    def _state(self) -> dict[str, Any]:
        try:
            state: dict[str, Any] = json.loads((self.data / "run" / "state.json").read_text())
        except FileNotFoundError:
            return {}
        return state

    def _child(self, name: str) -> psutil.Process | None:
        return processes.alive(self._state().get("children", {}).get(name)) if self.ready() else None

    def _find(self, fault: Fault) -> psutil.Process | None:
        """The process that a fault is for, None where it does not run now."""
        worker = self._workers[int(fault.pick * len(self._workers))]
        if fault.target == "supervisor":
            return processes.alive(self._process.pid) if self._process is not None and self.ready() else None
        if fault.target == "pool":
            return processes.child_of(self._child(worker))
        if fault.target == "trainer_pool":
            return processes.child_of(self._child("trainer"))
        return self._child(worker if fault.target == "worker" else fault.target)

    def _mount(self) -> None:
        """A file system of its own for the data, and the store in it mounted once more; nothing where we may not."""
        if os.geteuid() != 0:
            return
        size = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES},mode=0700", "tmpfs", str(self.data)]
        if subprocess.run(size, capture_output=True, check=False).returncode:
            return
        self._mounted.append(self.data)
        store = self.data / "store"
        store.mkdir()
        subprocess.run(["mount", "--bind", str(store), str(store)], check=True)
        self._mounted.append(store)

    def _fill(self) -> Callable[[], None]:
        """Take the last free byte of the file system."""
        ballast = self.data / BALLAST
        file = os.open(ballast, os.O_WRONLY | os.O_CREAT, 0o600)
        try:
            with suppress(OSError):
                free = os.statvfs(self.data)
                os.posix_fallocate(file, 0, free.f_bavail * free.f_frsize)
            os.lseek(file, 0, os.SEEK_END)
            with suppress(OSError):
                while os.write(file, bytes(4096)):
                    pass
        finally:
            os.close(file)
        return ballast.unlink

    def _limit_files(self) -> Callable[[], None] | None:
        """No file of the Python processes may grow; the broker would be killed by it and is left out."""
        broker = self._state().get("children", {}).get("broker")
        supervisor = processes.alive(None if self._process is None else self._process.pid)
        if supervisor is None:
            return None
        family = [supervisor, *supervisor.children(recursive=True)]
        changed = [process for process in family if process.pid != broker and _limit(process, 0)]
        return lambda: [_limit(process, None) for process in changed] and None

    def _remount(self) -> Callable[[], None] | None:
        """Make the store read-only, as soon as no file in it is open for writing."""
        store = str(self.data / "store")
        deadline = time.monotonic() + REMOUNT_WITHIN_S
        command = ["mount", "-o", "remount,bind,ro", store]
        while subprocess.run(command, capture_output=True, check=False).returncode:
            if time.monotonic() > deadline:
                return None
            time.sleep(0.01)

        def mend() -> None:
            if subprocess.run(["mount", "-o", "remount,bind,rw", store], check=False).returncode:
                raise CannotRun(f"{store} does not become writable again")

        return mend

    def _close_folders(self) -> Callable[[], None] | None:
        if os.geteuid() == 0:
            return None
        folders = [self.data / "store", *(path for path in (self.data / "store").rglob("*") if path.is_dir())]
        modes = {folder: folder.stat().st_mode & 0o777 for folder in folders}
        for folder in folders:
            folder.chmod(modes[folder] & 0o555)

        def mend() -> None:
            for folder, mode in modes.items():
                folder.chmod(mode)

        return mend


def _limit(process: psutil.Process, most: int | None) -> bool:
    """Limit the files of a process to so many bytes, None: as far as it may; whether it still runs."""
    try:
        hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)[1]
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (hard if most is None else most, hard))
    except (ProcessLookupError, psutil.NoSuchProcess):
        return False
    return True
