"""Bars of uploads and downloads, on the standard error stream.

All transfers of a client share one display, which is there while any of them lasts and leaves nothing behind. Without a
terminal nothing is shown, and nothing of rich is imported.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from threading import Lock
from typing import IO, TYPE_CHECKING, Any, cast

from physworld_client.bundle import Upload

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


class Bar:
    """One transfer's bar; without a display it does nothing."""

    def __init__(self, display: Progress | None = None, task: TaskID | None = None) -> None:
        self._display, self._task = display, task

    def begins(self, offset: int, rest: str | None) -> None:
        """So many bytes are there; ``rest`` is the header that says how many follow."""
        total = offset + int(rest) if rest and rest.isdigit() else None
        self._update(completed=offset, total=total)

    def moves(self, count: int) -> None:
        """So many more bytes have passed."""
        self._update(advance=count)

    def returns(self, place: int) -> None:
        """The transfer goes on from there."""
        self._update(completed=place)

    def _update(self, **change: Any) -> None:
        if self._display is not None and self._task is not None:
            self._display.update(self._task, **change)


class Bars:
    """The display that a client's transfers share.

    Args:
        shown: whether there is one; None: where the standard error stream is a terminal.
    """

    def __init__(self, shown: bool | None = None) -> None:
        self._shown = shown
        self._lock = Lock()
        self._display: Progress | None = None
        self._open = 0

    @contextmanager
    def receiving(self, name: str) -> Iterator[Bar]:
        """A bar while a download lasts."""
        with self._bar(name, None) as bar:
            yield bar

    @contextmanager
    def sending(self, upload: Upload) -> Iterator[Upload]:
        """The upload, whose stream moves a bar as it is read; a retry begins again."""
        with self._bar(upload.filename, _size(upload.stream)) as bar:
            yield replace(upload, stream=cast("IO[bytes]", _Watched(upload.stream, bar)))

    @contextmanager
    def _bar(self, name: str, total: int | None) -> Iterator[Bar]:
        shown = sys.stderr.isatty() if self._shown is None else self._shown
        if not shown:
            yield Bar()
            return
        with self._lock:
            if self._display is None:
                self._display = _display()
                self._display.start()
            self._open += 1
            display = self._display
            task = display.add_task(name, total=total)
        try:
            yield Bar(display, task)
        finally:
            with self._lock:
                display.remove_task(task)
                self._open -= 1
                if not self._open:
                    display.stop()
                    self._display = None


class _Watched:
    """A stream that tells a bar how far it was read; everything else is the stream's own."""

    def __init__(self, stream: IO[bytes], bar: Bar) -> None:
        self._stream, self._bar = stream, bar

    def read(self, size: int = -1) -> bytes:
        """Bytes of the stream."""
        data = self._stream.read(size)
        self._bar.moves(len(data))
        return data

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Another place in the stream; the bar goes there too."""
        place = self._stream.seek(offset, whence)
        if whence == os.SEEK_SET:
            self._bar.returns(place)
        return place

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _display() -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
    )
    return Progress(*columns, console=Console(stderr=True, force_terminal=True), transient=True)


def _size(stream: IO[bytes]) -> int:
    place = stream.tell()
    size = stream.seek(0, os.SEEK_END)
    stream.seek(place)
    return size
