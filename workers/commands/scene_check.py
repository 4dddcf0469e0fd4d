"""``python -m physworld_workers.commands.scene_check SCENE...``: every fault and warning of scenes, without a service.

A scene is read as an upload would be: a folder, an archive, PhysTwin's pickle, a C3D file. Exit codes: 0 every scene
may be used, 2 one of them is refused.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

REFUSED = 2


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, check every scene, say what was found."""
    parser = argparse.ArgumentParser(prog="physworld scenes check", description="Name the faults of scenes.")
    parser.add_argument("scenes", nargs="+", type=Path, help="folders or files")
    parser.add_argument("--json", action="store_true", help="print JSON")
    given = parser.parse_args(arguments)
    found = [check(path) for path in given.scenes]
    if given.json:
        print(json.dumps(found, indent=2))
    else:
        for one in found:
            _print(one)
    return 0 if all(one["valid"] for one in found) else REFUSED


def check(path: Path) -> dict[str, Any]:
    """What the validator says of the scene at a path.

    Returns:
        ``path``, ``valid``, ``faults`` and ``warnings``: texts; of a valid scene also ``name``, ``kind``, ``frames``,
        ``points``, ``controllers``, ``fps``.
    """
    from physworld_scenes.bundle import read_with_warnings
    from physworld_scenes.errors import SceneInvalid
    from physworld_scenes.importers import import_any
    from physworld_schemas.wording import reason

    answer: dict[str, Any] = {"path": str(path), "valid": False, "faults": [], "warnings": []}
    try:
        if path.is_dir():
            scene, warnings = read_with_warnings(path)
        else:
            scene, warnings = import_any(path.read_bytes(), path.name)
    except SceneInvalid as error:
        faults = [f"{'.'.join(map(str, fault.loc))}: {fault.msg}" for fault in error.faults]
        return answer | {"faults": faults}
    except OSError as error:
        return answer | {"faults": [reason(error)]}
    return answer | {
        "valid": True,
        "warnings": list(warnings),
        "name": scene.name,
        "kind": scene.kind,
        "frames": scene.frame_count,
        "points": scene.points.shape[1],
        "controllers": scene.controllers.shape[1],
        "fps": scene.fps,
    }


def _print(found: dict[str, Any]) -> None:
    if found["valid"]:
        shape = f"{found['frames']} frames at {found['fps']:g} Hz, {found['points']} points"
        print(
            f"{found['path']}: {found['name']}, {found['kind']}, {shape}, {found['controllers']} controllers"
        )
    else:
        print(f"{found['path']}: refused, {len(found['faults'])} fault{'s' * (len(found['faults']) != 1)}")
    for kind in ("faults", "warnings"):
        for text in found[kind]:
            print(f"  {kind[:-1]}: {text}")


if __name__ == "__main__":
    sys.exit(main())
