"""Reading of uploads in other processes, from the web process's side: ``physworld_services.api.parser_process`` does
the work.

The web process never holds an upload's content: it hands over a file and takes back a file and a page of facts. A file
that goes beyond its limits, or crashes its reader, is a refusal like any other, with the limit in it.
"""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog

from physworld_scenes.errors import SceneInvalid
from physworld_scenes.limited import environment
from physworld_schemas.base import FieldError
from physworld_services.api.errors import ApiProblem

ROOT = Path(__file__).parents[2]
STOPPED = {
    "cpu": "reading it takes more processor time than a file of its size may",
    "killed": "reading it takes more processor time or memory than a file of its size may",
    "wall": "reading it takes longer than a file of its size may",
    "memory": "reading it takes more memory or room on disk than a file of its size may",
    "crashed": "reading it crashed the reader",
}

log = structlog.get_logger("physworld.parsing")


@dataclass(frozen=True)
class Found:
    """What an upload turned out to hold: ``facts`` of the scene, and the file of its canonical archive."""

    facts: dict[str, Any]
    archive: Path


class Parsers:
    """Up to ``count`` parser processes, each started when it is first needed and again when it has died."""

    def __init__(self, count: int) -> None:
        self._idle: queue.LifoQueue[_Parser] = queue.LifoQueue()  # the one that has read last is warm
        for _ in range(count):
            self._idle.put(_Parser())

    def parse(self, folder: Path, filename: str, name: str | None, options: dict[str, Any]) -> Found:
        """Read the file ``upload`` in ``folder``; what comes of it lies there too.

        Args:
            filename: what the sender calls it.
            name: the scene's name, where it is not to be the file's.
            options: keyword arguments of ``physworld_scenes.importers.ImportOptions``.

        Raises:
            SceneInvalid: with every fault, or the limit that it went beyond.
            ApiProblem: 503, no parser process could be started.
        """
        request = {"folder": str(folder), "filename": filename, "name": name, "options": options}
        return Found(self._asked(folder, request), folder / "scene.zip")

    def look(self, folder: Path, filename: str, options: dict[str, Any]) -> dict[str, Any]:
        """What an import of the file ``upload`` in ``folder`` would guess: a ``ScenePreview``'s fields.

        Raises:
            SceneInvalid, ApiProblem: as of ``parse``.
        """
        return self._asked(
            folder,
            {"folder": str(folder), "filename": filename, "name": None, "options": options, "look": True},
        )

    def pictures(self, folder: Path, filename: str, options: dict[str, Any]) -> dict[str, Any]:
        """What the archive or film ``upload`` in ``folder`` shows first: a ``TrackingPreview``'s fields.

        Args:
            filename: what the sender calls it.
            options: ``up``, ``boxes`` and ``depth_scale`` of a ``TrackingOptions``.

        Raises:
            SceneInvalid, ApiProblem: as of ``parse``.
        """
        request: dict[str, Any] = {
            "folder": str(folder),
            "filename": filename,
            "name": None,
            "options": options,
        }
        return self._asked(folder, request | {"pictures": True})

    def _asked(self, folder: Path, request: dict[str, Any]) -> dict[str, Any]:
        """What the reader found. Raises SceneInvalid."""
        filename, size = request["filename"], (folder / "upload").stat().st_size
        with self._one() as parser:
            answer = parser.ask(request)
        log.info("upload_read", bytes=size, **answer)
        outcome = answer["outcome"]
        if outcome in STOPPED:
            used = f"{answer['cpu_s']:.1f} s of processor time and {answer['peak_bytes'] / 2**20:.0f} MiB"
            fault = FieldError(
                loc=[filename[:200] or "file"], msg=f"{STOPPED[outcome]}: {size} bytes took {used}"
            )
            raise SceneInvalid([fault])
        found: dict[str, Any] = json.loads((folder / "found.json").read_text())
        if outcome == "refused":
            raise SceneInvalid([FieldError.model_validate(fault) for fault in found["faults"]])
        return found

    def close(self) -> None:
        """End the processes that are idle."""
        while not self._idle.empty():
            self._idle.get_nowait().close()

    @contextmanager
    def _one(self) -> Iterator[_Parser]:
        parser = self._idle.get()
        try:
            yield parser
        finally:
            self._idle.put(parser)


class _Parser:
    """One parser process; used by one thread at a time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._end: weakref.finalize[[subprocess.Popen[str]], _Parser] | None = None

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request; a process that is gone is replaced once."""
        for _ in range(2):
            process = self._running()
            assert process.stdin is not None and process.stdout is not None
            try:
                process.stdin.write(json.dumps(request) + "\n")
                process.stdin.flush()
                line = process.stdout.readline()
            except OSError:
                line = ""
            if line:
                answer: dict[str, Any] = json.loads(line)
                return answer
            log.warning("parser_gone", status=process.poll())
            self.close()
        raise ApiProblem(
            503,
            "unavailable",
            "the process that reads uploads cannot be started",
            headers={"Retry-After": "5"},
        )

    def close(self) -> None:
        """End the process, as happens too where nobody has this parser any more."""
        if self._end is not None:
            self._end()
        self._process = self._end = None

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            self.close()
            self._process = subprocess.Popen(
                [sys.executable, "-m", "physworld_services.api.parser_process"],
                cwd=ROOT,
                env=environment(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            self._end = weakref.finalize(self, _ended, self._process)
        return self._process


def _ended(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
