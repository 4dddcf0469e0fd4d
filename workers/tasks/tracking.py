"""Follows an object in uploaded pictures, as ``physworld import`` does, and makes a scene of it.

A process of its own does it (``physworld_workers.tracking_child``): what strangers sent is read where it can harm
nothing (ADR 82), and a job that is cancelled ends at once, whatever code it is in. The folder that it works in is named
after the shard: an attempt that was killed leaves it, the next one on this machine empties it.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import selectors
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from physworld.errors import SplatNotFitted
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.limited import environment, stopped_by
from physworld_schemas.base import Artifact, FieldError
from physworld_workers import tracking_files as files
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.followed_pictures import read_views
from physworld_workers.stores import Stores

ROOT = Path(__file__).parents[2]
STAGES = {"reading": 5.0, "tracking": 50.0, "cloud": 1.0, "gripping": 35.0, "scene": 9.0}
"""Weights, as of a rendered beam of 90 pictures of 640 x 480 with a marker on its gripper."""
FITTING = {"splat": 500.0}
"""The same, where a splat of it is asked for."""
SPLAT = "splat.ply"
LOOK_S = 0.2
ASKED_BYTES = 1 << 16
STOPPED = {
    "cpu": "following it took more than {cpu_s} s of processor time",
    "wall": "following it took longer than {wall_s} s",
    "killed": "following it took more memory than this machine gives",
    "crashed": "its content crashed the process that read it",
}
OUT_OF_MEMORY = re.compile("memory alloc|allocate memory|bad_alloc", re.IGNORECASE)
"""How native libraries say that they met the limit on memory when they end a process."""
MEDIA_TYPES = {
    files.LOOK: "image/png",
    files.CAMERA: "application/json",
    files.FRAMES: "application/x-npz",
}


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Fetch, follow in the child, store."""
    payload = context.lease.payload
    if "upload" not in payload:
        raise ValueError(f"{payload['file']} is no longer kept; upload it again")
    context.plan(STAGES | (FITTING if payload["options"].get("fit_splat") else {}))
    with _folder(context.lease.shard_id) as folder:
        with (folder / files.UPLOAD).open("wb") as file:
            for piece in stores.artifacts.open(payload["upload"]):
                context.check()
                file.write(piece)
        request = {"file": payload["file"], "options": payload["options"]}
        (folder / files.REQUEST).write_text(json.dumps(request))
        _follow(context, folder, payload["file"])
        archive = stores.artifacts.put_file(folder / files.ARCHIVE, files.ARCHIVE, "application/zip")
        made = [archive]
        for name, media_type in MEDIA_TYPES.items():
            if (folder / name).is_file():
                context.check()
                made.append(stores.artifacts.put_file(folder / name, name, media_type))
        facts = json.loads((folder / files.FOUND).read_text())
        if (folder / files.VIEWS).is_file():
            try:
                made.append(_splat(context, stores, folder / files.VIEWS))
            except SplatNotFitted as error:
                facts["warnings"].append(f"no splat: {error}")
    result = {"facts": facts, "artifacts": [item.model_dump(mode="json") for item in made]}
    return HandlerResult(result, archive.sha256)


def _splat(context: TaskContext, stores: Stores, views: Path) -> Artifact:
    """Fit a splat to what the child saw of the first frame. Raises SplatNotFitted, Cancelled, LeaseLost."""
    from physworld.video import SplatConfig, fit_splat, to_ply

    config = SplatConfig(device=stores.settings.device)
    context.begin("splat", "steps", config.steps)

    def told(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, "steps", f"fitting {message}")

    fitted = fit_splat(read_views(views.read_bytes()), None, config, told)
    return stores.artifacts.put_bytes(to_ply(fitted.gaussians), SPLAT, "application/x-ply")


@contextlib.contextmanager
def _folder(shard_id: str) -> Iterator[Path]:
    """An empty folder of this user alone; gone afterwards."""
    folder = Path(tempfile.gettempdir()) / f"physworld-tracking-{shard_id}"
    if folder.is_dir() and not folder.is_symlink():
        shutil.rmtree(folder)
    folder.mkdir(mode=0o700)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _follow(context: TaskContext, folder: Path, filename: str) -> None:
    """Run the child to its end. Raises SceneInvalid with its faults, Cancelled, LeaseLost."""
    with (folder / "stderr").open("wb") as errors:
        child = subprocess.Popen(
            [sys.executable, "-m", "physworld_workers.tracking_child", str(folder)],
            cwd=ROOT,
            env=environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
        )
    try:
        stage = ""
        for done, total, message in _told(context, child):
            if (now := message.partition(",")[0]) != stage:
                context.begin(stage := now, "frames", total)
            context.progress(done, total, "frames", message)
        status = child.wait()
    finally:
        child.kill()
        child.wait()
        if child.stdout is not None:
            child.stdout.close()
    if status != 0:
        raise _failure(status, folder, filename)


def _told(context: TaskContext, child: subprocess.Popen[bytes]) -> Iterator[tuple[int, int, str]]:
    """What the child tells, until it ends; in between whether anybody still wants it is asked."""
    assert child.stdout is not None
    place = child.stdout.fileno()
    os.set_blocking(place, False)
    held = b""
    with selectors.DefaultSelector() as selector:
        selector.register(place, selectors.EVENT_READ)
        while True:
            context.check()
            if not selector.select(LOOK_S):
                continue
            piece = os.read(place, ASKED_BYTES)
            if not piece:
                return
            *lines, held = (held + piece).split(b"\n")
            if lines:
                done, total, message = json.loads(lines[-1])
                yield done, total, message


def _failure(status: int, folder: Path, filename: str) -> Exception:
    """Why the child gave no scene."""
    if status == files.REFUSED:
        found: dict[str, Any] = json.loads((folder / files.FOUND).read_text())
        return SceneInvalid([FieldError.model_validate(fault) for fault in found["faults"]])
    if status == files.NO_ROOM:
        return OSError(errno.ENOSPC, f"no room in {folder.parent} for what {filename} holds")
    lines = (folder / "stderr").read_text(errors="replace").strip().splitlines()
    last = lines[-1][:300] if lines else f"status {status}"
    limits = {"cpu_s": files.LIMITS.cpu_s, "wall_s": files.LIMITS.wall_s}
    if status == files.NO_MEMORY or (status > 0 and OUT_OF_MEMORY.search(last)):
        told = f"following it takes more than {files.LIMITS.memory_bytes} bytes of memory; give fewer frames or points"
    elif status < 0:
        told = STOPPED[stopped_by(status)].format(**limits)
    else:
        return RuntimeError(f"following {filename} failed: {last}")
    return SceneInvalid([FieldError(loc=[filename[:200]], msg=told)])
