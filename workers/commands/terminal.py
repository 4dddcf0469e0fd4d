"""What the commands share: reading a scene from a path, a progress bar, and the end of a command.

Exit codes: 0 done, 2 the input or the command line is wrong or the work failed with a typed error (one line on
standard error), 130 interrupted.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from physworld.errors import Cancelled, PhysworldError
from physworld.scene import Scene
from physworld_scenes.bundle import read_bundle
from physworld_scenes.importers import import_any
from physworld_schemas.wording import reason
from physworld_storage.errors import StorageError

FAILED, INTERRUPTED = 2, 130
PLAIN_INTERVAL_S = 5.0
WIDTH_ELSEWHERE = 140
NOTHING_WRITTEN = "nothing was written"


def read_scene(path: Path) -> Scene:
    """The scene in a folder, an archive, PhysTwin's pickle or a C3D file.

    Raises:
        SceneInvalid: with every fault.
        FileNotFoundError: there is nothing at ``path``.
    """
    if path.is_dir():
        return read_bundle(path)
    scene, _ = import_any(path.read_bytes(), path.name)
    return scene


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[int, int, str], None]]:
    """A function (done, total, message) that moves a bar on a terminal, or prints a line now and then elsewhere."""
    console = Console(stderr=True, highlight=False, width=None if sys.stderr.isatty() else WIDTH_ELSEWHERE)
    if not console.is_terminal:
        last = 0.0

        def line(done: int, total: int, message: str) -> None:
            nonlocal last
            if time.monotonic() - last >= PLAIN_INTERVAL_S:
                last = time.monotonic()
                console.print(f"{title} {done}/{total} {message}", markup=False, soft_wrap=True)

        yield line
        return
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("{task.fields[message]}", markup=False),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as shown:
        task = shown.add_task(title, total=None, message="")
        yield lambda done, total, message: shown.update(task, completed=done, total=total, message=message)


def guarded(command: Callable[[], None], left: Callable[[], str] = lambda: NOTHING_WRITTEN) -> int:
    """Run a command; its exit code. An error that we know is one line on standard error, never a traceback.

    ``left`` says after an interrupt what the command leaves behind.
    """
    try:
        command()
    except (KeyboardInterrupt, Cancelled):
        _say(f"cancelled; {left()}")
        return INTERRUPTED
    except (PhysworldError, StorageError, OSError, ValueError) as error:
        _say(f"error: {reason(error)}")
        return FAILED
    return 0


def _say(text: str) -> None:
    print(" ".join(text.split()), file=sys.stderr, flush=True)
