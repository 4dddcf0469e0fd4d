"""How the cameras of a folder of pictures are calibrated: their lenses, and where they stand.

- ``cameras.json``: a list of ``fx``, ``fy``, ``cx``, ``cy`` and ``world_to_camera`` (absent: not placed), the form of
  ``physworld video --camera``.
- PhysTwin: ``metadata.json`` (``intrinsics``, ``fps``); ``calibrate.pkl`` or ``.json``, camera to world of each camera.
- a file a camera: ``intrinsics/CAMERA.json``, Open3D's form or a matrix of 3 x 3, and ``extrinsics/CAMERA.json``, 4 x 4
  under the key that says which way, ``camera_to_world`` or ``world_to_camera``.
- Open3D: ``camera_intrinsic.json`` (its matrix by columns), of one camera.

The first that is there counts. Several cameras need their places; a place turns and shifts, and is in metres.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld_scenes.errors import refused
from physworld_scenes.importers.array_pickle import PickleRefused, load_arrays
from physworld_schemas.wording import reason

INTRINSICS = ("camera_intrinsic.json", "intrinsic.json", "intrinsics.json")
MOST_TEXT_BYTES = 1 << 20
FAR_M = 100.0
"""From one camera to another; farther ones are not given in metres."""
STRETCH = 1e-3
"""Of the lengths of a rotation's rows from 1, and of the cosines of their angles from 0."""


@dataclass(frozen=True)
class Calibration:
    """What the files say.

    Attributes:
        matrices: of the lenses, (3, 3) each.
        poses: camera to world, (4, 4) each, or None.
        fps: frames per second, or None.
        layout: which it is, for people.
    """

    matrices: list[Array]
    poses: list[Array] | None
    fps: float | None
    layout: str


def calibration_of(folder: Path, names: list[str]) -> Calibration:
    """The calibration of a folder's cameras.

    Args:
        folder: of the recording.
        names: of the cameras, in their order.

    Raises:
        SceneInvalid: it is missing, is not of its form, or is of other cameras; with the numbers.
    """
    read = _read(folder, names)
    if read.poses is None:
        return read
    middle = np.median([pose[:3, 3] for pose in read.poses], axis=0)
    for number, pose in enumerate(read.poses):
        lengths = np.linalg.norm(pose[:3, :3], axis=1)
        off = np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max()
        if off > STRETCH or np.linalg.det(pose[:3, :3]) < 0:
            told = ", ".join(f"{length:.4g}" for length in lengths)
            raise refused(
                read.layout,
                f"the place of camera {number} is no turn and shift: rows of length {told}, determinant "
                f"{np.linalg.det(pose[:3, :3]):.4g}, last row {pose[3].tolist()}",
            )
        away = float(np.linalg.norm(pose[:3, 3] - middle))
        if away > FAR_M:
            raise refused(
                read.layout, f"camera {number} stands {away:.4g} m from the others; places are in metres"
            )
    return read


def _read(folder: Path, names: list[str]) -> Calibration:
    cameras = len(names)
    if (folder / "cameras.json").is_file():
        return _plain(_json(folder / "cameras.json"), cameras)
    if (folder / "metadata.json").is_file():
        return _phystwin(folder, cameras)
    if (folder / "intrinsics").is_dir():
        return _apiece(folder, names)
    for name in INTRINSICS:
        if (folder / name).is_file():
            return _open3d(_json(folder / name), name, cameras)
    raise refused(
        folder.name,
        "says nothing of its lens: neither cameras.json, metadata.json, a folder intrinsics nor "
        + ", ".join(INTRINSICS),
    )


def _plain(content: Any, cameras: int) -> Calibration:
    facts = _expect("cameras.json", lambda: [dict(camera) for camera in content])
    if len(facts) != cameras:
        raise refused("cameras.json", f"describes {len(facts)} cameras, there are {cameras}")
    matrices = _expect(
        "cameras.json",
        lambda: [
            np.array([[f["fx"], 0.0, f["cx"]], [0.0, f["fy"], f["cy"]], [0.0, 0.0, 1.0]], dtype=float)
            for f in facts
        ],
    )
    placed = ["world_to_camera" in f for f in facts]
    if any(placed) != all(placed) or (len(facts) > 1 and not all(placed)):
        raise refused(
            "cameras.json",
            f"gives world_to_camera of {sum(placed)} of {cameras} cameras; several cameras need all",
        )
    poses = (
        _expect("cameras.json", lambda: [np.linalg.inv(_matrix(f["world_to_camera"], 4)) for f in facts])
        if all(placed)
        else None
    )
    return Calibration(matrices, poses, None, "plain")


def _phystwin(folder: Path, cameras: int) -> Calibration:
    facts = _json(folder / "metadata.json")
    matrices = _expect("metadata.json", lambda: [_matrix(m, 3) for m in facts["intrinsics"]])
    fps = _expect("metadata.json", lambda: None if facts.get("fps") is None else float(facts["fps"]))
    poses = None
    if (folder / "calibrate.json").is_file():
        listed = _json(folder / "calibrate.json")
        poses = _expect("calibrate.json", lambda: [_matrix(m, 4) for m in listed])
    elif (folder / "calibrate.pkl").is_file():
        try:
            listed = load_arrays(_bytes(folder / "calibrate.pkl"))
        except PickleRefused as error:
            raise refused("calibrate.pkl", str(error)) from error
        poses = _expect("calibrate.pkl", lambda: [_matrix(m, 4) for m in listed])
    if len(matrices) != cameras or (poses is not None and len(poses) != cameras):
        told = f"{len(matrices)} intrinsics and {len(poses) if poses is not None else 'no'} poses"
        raise refused("metadata.json", f"there are {cameras} cameras, but {told}")
    if poses is None and cameras > 1:
        raise refused("calibrate.pkl", f"is missing: {cameras} cameras need their places")
    return Calibration(matrices, poses, fps, "PhysTwin")


def _apiece(folder: Path, names: list[str]) -> Calibration:
    """A file a camera in ``intrinsics`` and ``extrinsics``."""
    parts = ("intrinsics", "extrinsics") if (folder / "extrinsics").is_dir() else ("intrinsics",)
    for part in parts:
        missing = [name for name in names if not (folder / part / f"{name}.json").is_file()]
        if missing:
            raise refused(
                part,
                f"has no {', '.join(f'{name}.json' for name in missing)}; there are {len(names)} cameras",
            )
    matrices = [_lens(folder / "intrinsics" / f"{name}.json") for name in names]
    if len(parts) < 2:
        if len(names) > 1:
            raise refused("extrinsics", f"is missing: {len(names)} cameras need their places")
        return Calibration(matrices, None, None, "a file a camera")
    poses = [_place(folder / "extrinsics" / f"{name}.json") for name in names]
    return Calibration(matrices, poses, None, "a file a camera")


def _lens(path: Path) -> Array:
    content = _json(path)
    if isinstance(content, dict):
        return _columns(content, path.name)
    matrix: Array = _expect(path.name, lambda: _matrix(content, 3))
    return matrix


def _place(path: Path) -> Array:
    content = _json(path)
    ways = [
        key for key in ("camera_to_world", "world_to_camera") if isinstance(content, dict) and key in content
    ]
    if len(ways) != 1:
        raise refused(
            f"extrinsics/{path.name}",
            f"has {len(ways)} of the keys camera_to_world and world_to_camera; one of them is needed",
        )
    matrix = _expect(f"extrinsics/{path.name}", lambda: _matrix(content[ways[0]], 4))
    return matrix if ways[0] == "camera_to_world" else np.linalg.inv(matrix)


def _open3d(content: Any, name: str, cameras: int) -> Calibration:
    if cameras != 1:
        raise refused(
            name, f"describes one camera, there are {cameras}; intrinsics/CAMERA.json describes one each"
        )
    return Calibration([_columns(content, name)], None, None, "Open3D")


def _columns(content: Any, name: str) -> Array:
    """Open3D's matrix, which it lists by columns, (3, 3)."""
    matrix: Array = _expect(name, lambda: _matrix(np.reshape(content["intrinsic_matrix"], (3, 3)).T, 3))
    return matrix


def _matrix(values: Any, size: int) -> Array:
    matrix = np.array(values, dtype=np.float64)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        raise ValueError(f"a matrix of shape {matrix.shape}, not an invertible one of {size} x {size}")
    return matrix


def _expect(name: str, read: Callable[[], Any]) -> Any:
    """What ``read`` gives, or the refusal of the file where it stumbles over its content."""
    try:
        return read()
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, np.linalg.LinAlgError) as error:
        raise refused(name, f"is not of its form: {reason(error)[:160]}") from error


def _json(path: Path) -> Any:
    try:
        return json.load(io.BytesIO(_bytes(path)))
    except (ValueError, RecursionError) as error:
        raise refused(path.name, f"is no JSON: {str(error)[:160]}") from error


def _bytes(path: Path) -> bytes:
    if path.stat().st_size > MOST_TEXT_BYTES:
        raise refused(path.name, f"has {path.stat().st_size} bytes, at most {MOST_TEXT_BYTES} are read")
    return path.read_bytes()
