"""Import of PhysTwin's ``final_data.pkl``.

Keys of the file: ``object_points``, ``object_colors`` (T, N, 3); ``object_visibilities``,
``object_motions_valid`` (T, N) bool; ``controller_points`` (T, K, 3); ``surface_points`` (S, 3);
``interior_points`` (I, 3). Its world is z-down with the ground at z = 0, 30 frames per second, metres. The
import turns it by pi about x, so that z is up and handedness stays: (x, y, z) to (x, -y, -z).

``object_motions_valid[t]`` says that the motion from t to t + 1 is trusted, so a point counts as visible in
frame t if it was seen there and its motion into t is trusted. Invisible points lie at zero in the file.
``rest_volume_points`` are PhysTwin's structure points: first frame, surface and interior, one a 5 mm cell.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.scene import Scene
from physworld_scenes.bundle import checked, scene_from_parts
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers.array_pickle import PickleRefused, load_arrays
from physworld_scenes.importers.options import Importer, ImportOptions, estimate_noise, split_of
from physworld_schemas.base import FieldError

FPS = 30.0
DEFAULT_KIND = "toy"
STRUCTURE_CELL_M = 5e-3
PICKLE_PROTOCOL = b"\x80"
MAX_PICKLE_BYTES = 1 << 30

Z_DOWN_TO_Z_UP = np.array([1.0, -1.0, -1.0])
"""A turn by pi about x."""

REQUIRED = {
    "object_points": ("T", "N", 3),
    "object_visibilities": ("T", "N"),
    "object_motions_valid": ("T", "N"),
    "controller_points": ("T", "K", 3),
    "surface_points": ("S", 3),
    "interior_points": ("I", 3),
}


def read(source: Path | str | bytes, options: ImportOptions | None = None) -> Scene:
    """The scene in a ``final_data.pkl`` (a path, or its bytes).

    Raises:
        SceneInvalid: with every fault; a pickle that calls something is named with what it wanted.
    """
    if not isinstance(source, bytes):
        path = Path(source)
        return read_bytes(path.read_bytes(), path.stem, options)[0]
    return read_bytes(source, "final_data", options)[0]


def read_bytes(data: bytes, name: str, options: ImportOptions | None = None) -> tuple[Scene, list[str]]:
    """The scene in a ``final_data.pkl``, and its warnings; ``name`` unless the options have one."""
    options = options or ImportOptions()
    content = _load(data)
    arrays = {key: np.asarray(content.pop(key)) for key in REQUIRED}
    points = _turn(arrays.pop("object_points"))
    visible = arrays["object_visibilities"].astype(bool)
    visible[1:] &= arrays["object_motions_valid"][:-1].astype(bool)
    surface, interior = _turn(arrays["surface_points"]), _turn(arrays["interior_points"])
    first = points[0, visible[0]]
    fps = options.fps or FPS
    stored = {
        "points": points,
        "visible": visible,
        "controllers": _turn(arrays["controller_points"]),
        "times": np.arange(len(points)) / fps,
        "surface_points": surface,
        "rest_volume_points": structure_points(first, surface, interior),
        "interior_points": interior,
        "object_visibilities": arrays["object_visibilities"],
        "object_motions_valid": arrays["object_motions_valid"],
    }
    if "object_colors" in content:
        stored["colors"] = np.asarray(content["object_colors"])
    noise = options.noise_sigma_m or estimate_noise(points, visible)
    declared = {
        "schema_version": 1,
        "name": options.name or name,
        "kind": options.kind or DEFAULT_KIND,
        "description": "imported from PhysTwin's final_data.pkl",
        "fps": fps,
        "gravity_m_s2": list(options.gravity_m_s2),
        "noise_sigma_m": noise,
        "split": split_of(len(points)),
        "initial_state": "as measured",
        "body": dict(options.body),
        "ground": {"height_m": 0.0, "friction": None},
        "grips": None,
        "notes": {
            "source": {"format": "PhysTwin final_data.pkl"},
            "frame": "turned by pi about x from the file's z-down frame",
            "visible": "object_visibilities[t] and object_motions_valid[t - 1]",
            "noise": "given" if options.noise_sigma_m else "upper estimate from third differences",
        },
    }
    return checked(scene_from_parts(declared, stored))


def structure_points(*clouds: Array) -> Array:
    """The points of all clouds (each (n, 3) [m]) in their order, the first of every 5 mm cell, (M, 3)."""
    points = np.concatenate(clouds)
    cells = np.floor(points / STRUCTURE_CELL_M).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(first)]


def _load(data: bytes) -> dict[Any, Any]:
    """The file's dictionary with the required arrays in shapes that agree."""
    if len(data) > MAX_PICKLE_BYTES:
        raise _invalid([f"has {len(data)} bytes, at most {MAX_PICKLE_BYTES} are read"])
    try:
        content = load_arrays(data)
    except PickleRefused as error:
        raise _invalid([str(error)]) from error
    if not isinstance(content, dict):
        raise _invalid([f"holds a {type(content).__name__}, not PhysTwin's dictionary"])
    faults: list[str] = []
    lengths: dict[str, int] = {}
    for key, wanted in REQUIRED.items():
        if key not in content:
            faults.append(f"has no {key}; there are {', '.join(sorted(map(str, content)))[:200]}")
            continue
        array = content[key]
        if (
            not isinstance(array, np.ndarray)
            or array.ndim != len(wanted)
            or array.shape[2:] not in ((), (3,))
        ):
            shape = getattr(array, "shape", type(array).__name__)
            faults.append(f"{key} has shape {shape}, not ({', '.join(map(str, wanted))})")
            continue
        for letter, length in zip(wanted, array.shape, strict=True):
            if isinstance(letter, str) and lengths.setdefault(letter, length) != length:
                faults.append(
                    f"{key} has shape {array.shape}: {letter} is {length} here, {lengths[letter]} before"
                )
    if not faults and not lengths["T"]:
        faults.append("object_points has no frame")
    if faults:
        raise _invalid(faults)
    return content


def _turn(points: Array) -> Array:
    """z-down to z-up; adding zero keeps the invisible points' zeros from becoming -0."""
    turned = np.array(points, dtype=np.float64)
    turned *= Z_DOWN_TO_Z_UP
    turned += 0.0
    return turned


def _invalid(messages: list[str]) -> SceneInvalid:
    return SceneInvalid([FieldError(loc=["final_data.pkl"], msg=message) for message in messages])


IMPORTER = Importer(
    "phystwin",
    "PhysTwin's final_data.pkl",
    (".pkl", ".pickle"),
    "tracked points with visibility, controllers, structure points; z-down becomes z-up",
    lambda data, filename: data[:1] == PICKLE_PROTOCOL or filename.lower().endswith((".pkl", ".pickle")),
    read_bytes,
)
