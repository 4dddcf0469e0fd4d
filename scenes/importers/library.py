"""Files that a library parses, away from this process: a forged one can at most end a child with limited memory.

A process that is such a child itself says so by ``limit_here``, and parses without another.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from physworld.arrays import Array
from physworld_scenes.archives import ArchiveRefused, read_arrays
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers.library_child import reader_of
from physworld_schemas.base import FieldError

CHILD_SECONDS = 120.0
MOST_BYTES = 512 << 20

_limited_here = False


def limit_here() -> None:
    """This process is one that a forged file may end: parse in it."""
    global _limited_here
    _limited_here = True


def parsed(form: str, data: bytes, where: str) -> tuple[dict[str, Array], dict[str, Any]]:
    """Arrays and facts of a file. Raises SceneInvalid: it cannot be read, with the library's reason."""
    if len(data) > MOST_BYTES:
        raise _invalid(where, f"has {len(data)} bytes, at most {MOST_BYTES} are read")
    with tempfile.TemporaryDirectory(prefix="physworld-import-") as folder:
        source = Path(folder) / f"recording.{form}"
        source.write_bytes(data)
        return parsed_file(form, source, where)


def parsed_file(form: str, source: Path, where: str) -> tuple[dict[str, Array], dict[str, Any]]:
    """The same of a file on the disk, which is not read into this process."""
    if (size := source.stat().st_size) > MOST_BYTES:
        raise _invalid(where, f"has {size} bytes, at most {MOST_BYTES} are read")
    return _here(form, source, where) if _limited_here else _in_child(form, source.resolve(), where)


def _here(form: str, source: Path, where: str) -> tuple[dict[str, Array], dict[str, Any]]:
    try:
        return reader_of(form)(str(source))
    except MemoryError:
        raise
    except Exception as error:
        raise _invalid(where, f"cannot be read: {str(error)[:200] or type(error).__name__}") from error


def _in_child(form: str, source: Path, where: str) -> tuple[dict[str, Array], dict[str, Any]]:
    with tempfile.TemporaryDirectory(prefix="physworld-import-") as folder:
        target = Path(folder) / "content.npz"
        module = "physworld_scenes.importers.library_child"
        command = [sys.executable, "-m", module, form, str(source), str(target)]
        try:
            child = subprocess.run(
                command,
                cwd=Path(__file__).parents[2],
                capture_output=True,
                timeout=CHILD_SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise _invalid(where, f"reading it took more than {CHILD_SECONDS:.0f} s") from error
        if child.returncode != 0 or not target.is_file():
            lines = child.stderr.decode(errors="replace").strip().splitlines()
            reason = lines[-1][:200] if lines else f"exit status {child.returncode}"
            raise _invalid(where, f"cannot be read: {reason}")
        try:
            return read_arrays(target.read_bytes(), text=True), json.loads(child.stdout)
        except ArchiveRefused as error:
            raise _invalid(where, f"cannot be read: {error}") from error


def _invalid(where: str, message: str) -> SceneInvalid:
    return SceneInvalid([FieldError(loc=[where], msg=message)])
