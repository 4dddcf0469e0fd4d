"""The process that reads uploads: ``python -m physworld_services.api.parser_process``, started by
``physworld_services.api.parsing``.

It has imported what the importers need and then, for each line on its standard input, forks a child that reads one
upload under limits which the kernel keeps, waits for it, and answers with a line. The limits, of processor seconds,
memory, wall clock and output, grow with the upload's size, so that a long recording is read and a small file that
unfolds is not. Hostile content meets neither the web process nor its secrets: this process has none in its
environment.

A request is ``{"folder", "filename", "name", "options", "look"}``: the upload lies in the folder as ``upload``; the
child leaves ``scene.zip``, the canonical archive, and ``found.json`` beside it; with ``look`` what an import would
guess alone, with ``pictures`` what cameras show first. An answer is ``{"outcome", "cpu_s", "peak_bytes"}``.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import os
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

import scipy.spatial  # noqa: F401  so that a child need not
import trimesh  # noqa: F401

from physworld.tracking.view import Box
from physworld_scenes.bundle import checked, write_archive
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.facts import facts_of
from physworld_scenes.importers import ImportOptions, import_any, look_at
from physworld_scenes.importers.first_cloud import first_cloud
from physworld_scenes.importers.library import limit_here
from physworld_scenes.importers.unpacked import first_pictures, media_type_of, unpacked
from physworld_scenes.limited import (
    FAULT_CHARACTERS,
    MEBIBYTE,
    MOST_FAULTS,
    Limits,
    die_with_parent,
    stopped_by,
    told,
)
from physworld_schemas.base import FieldError

UPLOAD, ARCHIVE, FOUND = "upload", "scene.zip", "found.json"
CPU_S, BYTES_A_CPU_S = 4, 16 * MEBIBYTE
WALL_S, WALL_A_CPU_S = 30, 4
MEMORY_BYTES, MEMORY_A_BYTE = 256 * MEBIBYTE, 8
OUTPUT_BYTES = 1152 * MEBIBYTE
SHOWN_BYTES = 32 * MEBIBYTE
REFUSED, TOO_LARGE = 2, 3  # exit statuses of a child: faults are in found.json; memory or output ran out


def limits_of(size: int) -> Limits:
    """What reading an upload of ``size`` bytes may take."""
    cpu_s = CPU_S + size // BYTES_A_CPU_S
    return Limits(cpu_s, WALL_S + WALL_A_CPU_S * cpu_s, MEMORY_BYTES + MEMORY_A_BYTE * size, OUTPUT_BYTES)


def main() -> int:
    """Serve until the web process closes the pipe, which it does by ending, too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the web process's to act on
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if child == 0:
            os._exit(_read(request))
        _, status, used = os.wait4(child, 0)
        answer = {
            "outcome": _outcome(status),
            "cpu_s": used.ru_utime + used.ru_stime,
            "peak_bytes": used.ru_maxrss * 1024,
        }
        print(json.dumps(answer), flush=True)
    return 0


def _outcome(status: int) -> str:
    """What became of a child: ``read``, ``refused``, or the limit that stopped it."""
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        return stopped_by(code)
    return {0: "read", REFUSED: "refused", TOO_LARGE: "memory"}.get(code, "crashed")


def _read(request: dict[str, Any]) -> int:
    """In the child: read, check, write; the exit status."""
    folder = Path(request["folder"])
    try:
        die_with_parent()
        os.close(0)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # answers are the parent's
        limits_of((folder / UPLOAD).stat().st_size).impose()
        tempfile.tempdir = str(folder)  # what a killed child leaves goes with the upload
        if request.get("pictures"):
            (folder / FOUND).write_text(
                json.dumps(_pictured(folder, request["filename"], request["options"]))
            )
            return 0
        data = (folder / UPLOAD).read_bytes()
        options = ImportOptions(**request["options"])
        limit_here()
        if request.get("look"):
            (folder / FOUND).write_text(json.dumps(_looked(data, request["filename"], options)))
            return 0
        scene, warnings = import_any(data, request["filename"], options)
        if request["name"] is not None and request["name"] != scene.name:
            scene, warnings = checked(dataclasses.replace(scene, name=request["name"]))
        with (folder / ARCHIVE).open("w+b") as stream:
            write_archive(scene, stream)
        (folder / FOUND).write_text(json.dumps(facts_of(scene, warnings)))
        return 0
    except SceneInvalid as error:
        return _refuse(folder, error.faults)
    except (MemoryError, OSError):
        return TOO_LARGE


def _looked(data: bytes, filename: str, options: ImportOptions) -> dict[str, Any]:
    """What an import would guess."""
    title, found = look_at(data, filename, options)
    guess, marker = ("what", "value", "how", "option"), ("name", "roles", "rigid", "place_m")
    return {
        "importer": title,
        "guesses": [dict(zip(guess, row, strict=True)) for row in found.guesses],
        "lines": [line[:FAULT_CHARACTERS] for line in found.lines[:MOST_FAULTS]],
        "markers": [dict(zip(marker, row, strict=True)) for row in found.markers],
        "axes": found.axes,
    }


def _pictured(folder: Path, filename: str, options: dict[str, Any]) -> dict[str, Any]:
    """What each camera of an archive of pictures shows first, as far as it is small enough to be shown, and its cloud.

    Args:
        folder: in which it lies.
        filename: what its sender calls it.
        options: ``up``, ``boxes`` and ``depth_scale``.
    """
    place, shown, left = folder / "pictures", [], SHOWN_BYTES
    place.mkdir()
    recording = unpacked(folder / UPLOAD, filename, place)
    form, cameras = first_pictures(recording)
    for number, (name, frames, picture) in enumerate(cameras):
        camera: dict[str, Any] = {"camera": number, "name": name, "frames": frames}
        if picture and len(picture) <= left:
            left -= len(picture)
            camera |= {"media_type": media_type_of(picture), "data": base64.b64encode(picture).decode()}
        shown.append(camera)
    cloud = _clouded(recording, options) if form == "rgbd" else {}
    return {"form": form, "cameras": shown, **cloud}


def _clouded(recording: Path, options: dict[str, Any]) -> dict[str, Any]:
    """The cloud of the first frame, or why there is none: who only wants to draw a box is not refused."""
    try:
        boxes = {int(camera): Box(*corners) for camera, corners in options["boxes"].items()}
        found = first_cloud(recording, options["up"], boxes, options["depth_scale"])
    except SceneInvalid as error:
        return {"unclouded": str(error)[:FAULT_CHARACTERS]}
    except ImportError as error:
        return {"unclouded": f"{error.name} is not installed here, which reads it"}
    except MemoryError:
        return {"unclouded": "it takes more memory than a look may"}
    cloud = {
        "places_m": found.places.round(5).tolist(),
        "colours": found.colours.tolist(),
        "cameras": found.cameras.tolist(),
        "pixels": found.pixels.tolist(),
        "ground_m": found.ground,
        "up": found.up,
        "warnings": found.warnings,
    }
    return {"cloud": cloud}


def _refuse(folder: Path, faults: list[FieldError]) -> int:
    (folder / FOUND).write_text(json.dumps({"faults": told(faults), "count": len(faults)}))
    return REFUSED


if __name__ == "__main__":
    sys.exit(main())
