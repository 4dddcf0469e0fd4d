"""The data folder: where everything lies, who may run in it, and what runs in it now.

``run/lock`` is held by the supervisor for as long as it lives. ``run/family.lock`` is held, shared, by the
supervisor's children and their children (they inherit the open file), so whoever gets it exclusively knows
that nobody of an earlier run is left. Both are ``flock``: the kernel lets go of them however the holder
dies.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

POLL_S = 0.05


class AlreadyRunning(Exception):
    """Another supervisor holds the folder; ``state`` is what it wrote of itself (empty: nothing yet)."""

    def __init__(self, root: Path, state: dict[str, Any]) -> None:
        super().__init__(f"a service is already running on {root} (pid {state.get('pid', 'unknown')})")
        self.state = state


class StillAlive(Exception):
    """Processes of an earlier run did not end."""


@dataclass(frozen=True)
class DataFolder:
    """Paths below ``root``; everything in it is private to its owner."""

    root: Path

    def prepare(self) -> None:
        """Make the folders, readable by their owner only."""
        for path in (self.root, self.run, self.logs, self.broker):
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.run.chmod(0o700)
        self.broker.chmod(0o700)

    @property
    def run(self) -> Path:
        """State of the running service."""
        return self.root / "run"

    @property
    def logs(self) -> Path:
        """One file a child."""
        return self.root / "logs"

    @property
    def broker(self) -> Path:
        """The broker's append-only files."""
        return self.root / "broker"

    @property
    def digest(self) -> str:
        """Eight characters that tell this folder from others."""
        return hashlib.sha256(str(self.root.resolve()).encode()).hexdigest()[:8]

    @property
    def api_key(self) -> Path:
        """The administrator's key."""
        return self.root / "api-key"

    @property
    def state(self) -> Path:
        """What runs, for people and for the command line."""
        return self.run / "state.json"

    @property
    def port(self) -> Path:
        """The port of the last run, which the next one takes again."""
        return self.root / "run" / "port"

    def last_port(self) -> int:
        """The port of the last run; 0 where there was none or the file holds none."""
        try:
            port = int(self.port.read_text())
        except (FileNotFoundError, ValueError):
            return 0
        return port if 0 < port < 65536 else 0

    def read_state(self) -> dict[str, Any]:
        """The last state written; empty if there is none."""
        try:
            state: dict[str, Any] = json.loads(self.state.read_text())
        except FileNotFoundError:
            return {}
        return state

    def write_state(self, state: dict[str, Any]) -> None:
        """Replace the state file in one step."""
        write_private(self.state, json.dumps(state, indent=2) + "\n")


class FolderLocks:
    """Both locks of a data folder, as the supervisor holds them."""

    def __init__(self, folder: DataFolder) -> None:
        self._folder = folder
        self._own = _open(folder.run / "lock")
        try:
            fcntl.flock(self._own, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._own)
            raise AlreadyRunning(folder.root, folder.read_state()) from None
        self._family = _open(folder.run / "family.lock")

    @property
    def family_descriptor(self) -> int:
        """The open file that every child inherits."""
        return self._family

    def wait_until_alone(self, seconds: float) -> None:
        """Return once no process of an earlier run is left. Raises StillAlive after ``seconds``.

        A descriptor opened here asks, so that what our own children hold counts as well.
        """
        asking = _open(self._folder.run / "family.lock")
        deadline = time.monotonic() + seconds
        try:
            while True:
                try:
                    fcntl.flock(asking, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    return
                except BlockingIOError:
                    if time.monotonic() > deadline:
                        raise StillAlive(
                            f"processes of an earlier run on {self._folder.root} live on "
                            f"after {seconds:.0f} s"
                        ) from None
                    time.sleep(POLL_S)
        finally:
            os.close(asking)

    def hold_family(self) -> None:
        """Take the shared lock that children inherit."""
        fcntl.flock(self._family, fcntl.LOCK_SH)

    def leave_family(self) -> None:
        """Let go of our own hold, so that only children count."""
        os.close(self._family)
        self._family = _open(self._folder.run / "family.lock")

    def close(self) -> None:
        """Release the folder."""
        os.close(self._family)
        os.close(self._own)


def write_private(path: Path, text: str) -> None:
    """Write a file of mode 0600 in one step: a reader sees the old text or the new one."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def _open(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
