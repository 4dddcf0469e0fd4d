"""The real embedded service in tests: started as a person starts it, looked at from outside."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil

from physworld_storage.database import Database, open_database
from physworld_storage.jobs import jobs
from physworld_storage.settings import Settings
from physworld_workers.stores import Stores

START_WITHIN_S = 120.0
END_WITHIN_S = 30.0
POLL_S = 0.05


class ServiceProcess:
    """``python -m physworld_services.embedded`` on a data folder, in a session of its own; ended with the block."""

    def __init__(self, data: Path, *options: str, variables: dict[str, str] | None = None) -> None:
        self.data = data
        self.options = options
        self.variables = variables or {}
        self.output = data.parent / f"{data.name}.out"
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> ServiceProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            self.process.wait(END_WITHIN_S)

    def start(self) -> ServiceProcess:
        """Start and wait until it says that it is ready."""
        with self.output.open("ab") as output:
            self.process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "physworld_services.embedded",
                    "--data",
                    str(self.data),
                    *self.options,
                ],
                cwd=Path(__file__).resolve().parents[1],
                env={**environment(), **self.variables},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        pid = self.process.pid

        def ready() -> bool:
            assert self.process is not None
            assert self.process.poll() is None, self.output.read_text()
            return self.state().get("pid") == pid and bool(self.state()["ready"])

        until(ready, "the service is not ready", START_WITHIN_S)
        return self

    def state(self) -> dict[str, Any]:
        """``run/state.json``; empty when there is none."""
        path = self.data / "run" / "state.json"
        return json.loads(path.read_text()) if path.exists() else {}

    def family(self) -> list[psutil.Process]:
        """The supervisor and everything below it, now."""
        assert self.process is not None
        supervisor = psutil.Process(self.process.pid)
        return [supervisor, *supervisor.children(recursive=True)]

    def interrupt(self) -> int:
        """Ctrl-C; the exit code."""
        assert self.process is not None
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(END_WITHIN_S)

    def kill_child(self, name: str) -> int:
        """kill -9 of one child; its pid."""
        pid = int(self.state()["children"][name])
        os.kill(pid, signal.SIGKILL)
        return pid

    def kill(self) -> None:
        """kill -9 of the supervisor; returns once the rest of the family is gone too."""
        family = self.family()
        assert self.process is not None
        self.process.kill()
        self.process.wait()
        _, alive = psutil.wait_procs(family, END_WITHIN_S)
        assert alive == []

    def settings(self) -> Settings:
        """Settings of a process that looks at the same data folder."""
        return Settings(data_dir=self.data)

    def stores(self) -> tuple[Database, Stores]:
        """Database and stores of the same data folder."""
        settings = self.settings()
        database = open_database(settings)
        return database, Stores(settings, database)


def environment() -> dict[str, str]:
    """This process's environment without any address of a broker, a database or a store."""
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("PHYSWORLD_", "REDIS_"))
    }
    return {**kept, "OMP_NUM_THREADS": "1"}


def until(condition: Callable[[], bool], what: str, seconds: float) -> None:
    """Wait for a condition; AssertionError with ``what`` when it does not come."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"{what} after {seconds:.0f} s"
        time.sleep(POLL_S)


def wait_for_job(database: Database, job_id: str, seconds: float) -> None:
    """Wait until the job has succeeded."""

    def succeeded() -> bool:
        with database.reading() as session:
            job = jobs.get_job(session, job_id)
        assert job.state in {"queued", "running", "succeeded"}, job.error
        return job.state == "succeeded"

    until(succeeded, f"job {job_id} is not done", seconds)
