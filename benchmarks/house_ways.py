"""``python -m benchmarks.house_ways WAY SCENE [--tree FOLDER]``: through which files a reader follows a piece of work.

The work is done, and the calls of the project's own functions are watched. A reader follows every function into what
it calls, each of them once, and goes back where it ends. A *stay* is a stretch of reading in one file; a *return* is a
stay in a file that was left before. Imports and calls between the functions of one file are no stays.

Ways: ``scene`` reads and checks a recording as an upload is read; ``fit`` calibrates a twin of it. The same script
follows a checkout from before the rooms were rebuilt.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import os
import sys
from collections.abc import Callable
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

SMALL_FIT = ("--particles", "60", "--simulations", "6", "--quick")
ROOMS = ("physworld", "scenes", "schemas", "storage", "workers", "services", "clients")


def followed(work: Callable[[], Any], tree: Path) -> list[str]:
    """The files in which a reader stays, in their order, as they do the work.

    Only the process that calls is watched: what others simulate is read elsewhere.
    """
    tree = tree.resolve()
    names: dict[CodeType, str | None] = {}
    entered: list[FrameType] = []
    stays: list[str] = []
    imports: list[FrameType] = []

    def name_of(code: CodeType) -> str | None:
        """The file of a function of ours that has not been read yet."""
        path = Path(os.path.realpath(code.co_filename))
        if code.co_name.startswith("<") or not path.is_relative_to(tree):
            return None
        place = path.relative_to(tree)
        return place.as_posix() if place.parts[0] in ROOMS else None

    def stay(name: str) -> None:
        if not stays or stays[-1] != name:
            stays.append(name)

    def watch(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_name == "<module>":
            imports.append(frame)
        elif event == "return" and imports and imports[-1] is frame:
            imports.pop()
        elif imports:
            return
        elif event == "call" and frame.f_code.co_flags & CO_OPTIMIZED and frame.f_code not in names:
            name = names[frame.f_code] = name_of(frame.f_code)
            if name is not None:
                entered.append(frame)
                stay(name)
        elif event == "return" and entered and entered[-1] is frame:
            entered.pop()
            if entered:
                stay(str(names[entered[-1].f_code]))

    sys.setprofile(watch)
    try:
        work()
    finally:
        sys.setprofile(None)
    return stays


def work_of(way: str, scene: Path, prefix: str) -> Callable[[], Any]:
    """What is done; imported before it is watched.

    Args:
        way: ``scene`` or ``fit``.
        scene: an archive of a recording.
        prefix: of the names by which the tree's packages are imported.
    """
    if way == "scene":
        importers = importlib.import_module("physworld_scenes.importers" if prefix else "storage.importers")
        bundle = importlib.import_module("physworld_scenes.bundle" if prefix else "storage.scene_bundle")

        def read() -> None:
            found, _ = importers.import_any(scene.read_bytes(), scene.name, importers.ImportOptions())
            bundle.canonical_archive(found)

        return read
    main = importlib.import_module(f"{prefix}workers.commands.fit").main

    def command() -> None:
        sys.argv = [way, str(scene), *SMALL_FIT]
        with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
            main()

    return command


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("way", choices=["scene", "fit"])
    parser.add_argument("scene", type=Path, help="an archive of a recording")
    parser.add_argument("--tree", type=Path, default=Path(__file__).parents[1], help="the checkout to follow")
    given = parser.parse_args()
    prefix = "physworld_" if (given.tree / "scenes").is_dir() else ""
    if not prefix:
        sys.path.insert(0, str(given.tree))
    stays = followed(work_of(given.way, given.scene, prefix), given.tree)
    counts = {"files": len({*stays}), "stays": len(stays), "returns": len(stays) - len({*stays})}
    print(json.dumps({"way": given.way, **counts, "order": list(dict.fromkeys(stays))}, indent=1))


if __name__ == "__main__":
    main()
