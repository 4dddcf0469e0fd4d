"""``physworld status``, ``logs`` and ``down``: the service that runs, what it writes, and its end."""

from __future__ import annotations

import json as jsonlib
import os
import signal
import time
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from physworld_client.cli import service
from physworld_client.cli.options import Data, Json, Token, Url
from physworld_client.cli.output import ago, progress_text, stdout
from physworld_client.errors import PhysWorldError
from physworld_client.types import Job

SHOWN_JOBS = 10
STOP_WITHIN_S = 30.0
LOOK_S = 0.2
TAIL_BYTES = 1 << 20


def status(url: Url = None, token: Token = None, data: Data = None, json: Json = False) -> None:
    """Whether a service runs, where, and what it works on. Exit code 1 where none does."""
    address = service.find(url, token, data)
    if address is None:
        where = service.data_folder(data)
        if json:
            print(jsonlib.dumps({"running": False, "data": str(where)}))
        else:
            stdout.print(f"no service runs on {where}: start it with `physworld up`", soft_wrap=True)
        raise typer.Exit(1)
    state = {} if address.data is None else service.state_of(address.data)
    with address.client() as client:
        active: list[Job] = []
        for known in ("running", "cancelling", "queued"):
            active += client.jobs.list(state=known, limit=SHOWN_JOBS).data
    if json:
        facts: dict[str, Any] = {
            "running": True,
            "api_url": address.url,
            "dashboard_url": address.dashboard_url,
            "data": None if address.data is None else str(address.data),
            "pid": state.get("pid"),
            "started_at": state.get("started_at"),
            "processes": state.get("children", {}),
            "jobs": [job.model_dump(mode="json") for job in active],
        }
        print(jsonlib.dumps(facts, indent=2))
        return
    stdout.print(f"API        {address.url}/v1", soft_wrap=True)
    stdout.print(f"dashboard  {address.dashboard_url}", soft_wrap=True)
    if address.data is not None:
        since = (
            f", up for {ago(datetime.fromisoformat(state['started_at']))}" if "started_at" in state else ""
        )
        stdout.print(f"data       {address.data}", soft_wrap=True)
        names = ", ".join(sorted(state.get("children", {})))
        stdout.print(f"processes  {names} (pid {state.get('pid')}{since})", soft_wrap=True)
    for job in active:
        stdout.print(
            f"{job.id}  {job.kind:<10} {job.state:<10} {progress_text(job)}", markup=False, soft_wrap=True
        )
    if not active:
        stdout.print("no job is under way")


def logs(
    name: Annotated[
        str | None, typer.Argument(help="Of a process: worker-1, trainer, web ... [all].")
    ] = None,
    lines: Annotated[int, typer.Option("--lines", "-n", min=1, help="Of each, the last so many.")] = 20,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on printing what is written.")] = False,
    data: Data = None,
) -> None:
    """What the processes of the embedded service write, running or not."""
    folder = service.data_folder(data) / "logs"
    known = {path.stem: path for path in sorted(folder.glob("*.log"))}
    if not known:
        raise PhysWorldError(f"no logs lie in {folder}")
    if name is not None and name not in known:
        raise PhysWorldError(f"no process is called {name!r}: {', '.join(known)}")
    chosen = known if name is None else {name: known[name]}
    places = {}
    for process, path in chosen.items():
        text, places[process] = _tail(path, lines)
        _print(text, "" if name else process)
    while follow:
        time.sleep(LOOK_S)
        for process, path in chosen.items():
            size = path.stat().st_size
            if size < places[process]:  # it was cut: what follows is at its new end
                places[process] = 0
            if size > places[process]:
                with path.open("rb") as file:
                    file.seek(places[process])
                    more = file.read()
                places[process] += len(more)
                _print(more.decode(errors="replace").splitlines(), "" if name else process)


def down(data: Data = None) -> None:
    """Stop the embedded service that runs on the data folder; running work goes on at the next start."""
    folder = service.data_folder(data)
    state = service.state_of(folder)
    pid = state.get("pid")
    if not isinstance(pid, int) or service.running_on(folder) is None:
        raise PhysWorldError(f"no service runs on {folder}")
    os.kill(pid, signal.SIGTERM)
    end = time.monotonic() + STOP_WITHIN_S
    while service.state_of(folder).get("pid") == pid:
        if time.monotonic() > end:
            raise PhysWorldError(
                f"the service on {folder} (pid {pid}) has not ended within {STOP_WITHIN_S:g} s"
            )
        time.sleep(LOOK_S)
    stdout.print(f"stopped; physworld up --data {folder} takes it up again", soft_wrap=True)


def _tail(path: Path, lines: int) -> tuple[list[str], int]:
    """The last lines of a file, and its size [bytes]."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - TAIL_BYTES))
        text = file.read().decode(errors="replace")
    return text.splitlines()[-lines:], size


def _print(lines: list[str], process: str) -> None:
    for line in lines:
        print(f"{process}: {line}" if process else line, flush=True)
