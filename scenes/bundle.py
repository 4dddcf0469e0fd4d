"""Scene bundles: ``scene.json`` (what is declared) and ``scene.npz`` (what was measured), SI units, z up.

A bundle is a folder, a zip or a tar (plain or gzip); in an archive the files may lie in one top folder. Meshes of
colliders lie beside the two.
Reading validates; a scene with a fault is never returned. ``canonical_archive`` writes the one archive that a
scene's content has: its digest addresses the scene. Nothing is lost on the way through: keys and arrays that
no code here knows stay in ``Scene.declared`` and ``Scene.extra_arrays``.
"""

from __future__ import annotations

import copy
import io
import json
import shutil
import tempfile
from pathlib import Path
from typing import IO, Any

import numpy as np

from physworld.arrays import Array
from physworld.scene import AS_MEASURED, UNDEFORMED_AT_REST, Body, Grip, Ground, Scene, sigma_of
from physworld.shapes.surface_mesh import SurfaceMesh
from physworld_scenes.archive_writing import Member, stream_arrays, stream_zip
from physworld_scenes.archives import (
    DEFAULT_LIMITS,
    ArchiveLimits,
    ArchiveRefused,
    read_archive,
    read_arrays,
    single_folder,
)
from physworld_scenes.colliders import (
    MAX_MESH_BYTES,
    Fetch,
    collider_facts,
    colliders_of,
    fetch_meshes,
    mesh_files,
    meshes_of,
)
from physworld_scenes.declaration import SCHEMA_VERSION, UNDEFORMED_TEXT, parse_json
from physworld_scenes.errors import SceneInvalid, refused
from physworld_scenes.measured import hold
from physworld_scenes.validation import check_scene
from physworld_schemas.base import FieldError
from physworld_schemas.wording import pictures_among

JSON_NAME = "scene.json"
ARRAYS_NAME = "scene.npz"
SPOOLED_BYTES, COPIED_BYTES, COPIED_VALUES = 32 << 20, 1 << 20, 1 << 18
"""What stays in memory of an archive that is being written, and what is copied at once."""

FIELD_OF_ARRAY = {
    "points": "points",
    "visible": "visible",
    "controllers": "controllers",
    "times": "times",
    "controller_velocities": "controller_velocities",
    "controller_errors": "controller_errors_m",
    "ctrl_times": "control_times",
    "ctrl_points": "control_points",
    "rest_volume_points": "rest_volume_points",
    "surface_points": "surface_points",
    "colors": "colors",
    "part_features": "part_features",
    "noise_covariance": "noise_covariance_m2",
}
"""Name in ``scene.npz`` to field of ``Scene``; every other array is kept in ``extra_arrays``."""

KEPT_AS_STORED = frozenset({"visible", "colors"})
CLOCKS = frozenset({"times", "ctrl_times"})
VECTOR_FACTS = ("size_m", "box_min_m", "box_max_m", "segment_rest_lengths_m")
NUMBER_FACTS = ("length_m", "side_m", "thickness_m", "radius_m", "density_kg_m3", "mass_kg")


def read_bundle(path: Path | str, limits: ArchiveLimits = DEFAULT_LIMITS) -> Scene:
    """The scene in a folder or an archive; see ``read_with_warnings``."""
    return read_with_warnings(path, limits)[0]


def read_with_warnings(path: Path | str, limits: ArchiveLimits = DEFAULT_LIMITS) -> tuple[Scene, list[str]]:
    """The scene in a folder or an archive, and the warnings that it travels with.

    Raises:
        SceneInvalid: with every fault that the reading found.
        FileNotFoundError: there is nothing at ``path``.
    """
    path = Path(path)
    if not path.is_dir():
        return bundle_from_bytes(path.read_bytes(), limits)
    missing = [name for name in (JSON_NAME, ARRAYS_NAME) if not (path / name).is_file()]
    if missing:
        pictures = pictures_among((file.name for file in path.rglob("*")), str(path))
        more = f"; {pictures}" if pictures else ""
        faults = [FieldError(loc=[name], msg=f"is not in the folder {path}") for name in missing]
        raise SceneInvalid([*faults[:-1], FieldError(loc=faults[-1].loc, msg=faults[-1].msg + more)])
    for name in (JSON_NAME, ARRAYS_NAME):
        size = (path / name).stat().st_size
        if size > limits.total_bytes:
            raise refused(name, f"has {size} bytes, at most {limits.total_bytes} are read")

    def fetch(name: str) -> bytes | None:
        file = (path / name).resolve()
        inside = file.is_relative_to(path.resolve()) and file.is_file()
        return file.read_bytes() if inside and file.stat().st_size <= MAX_MESH_BYTES else None

    json_text, npz = (path / JSON_NAME).read_bytes(), (path / ARRAYS_NAME).read_bytes()
    return scene_from_files(json_text, npz, limits, fetch)


def bundle_from_bytes(data: bytes, limits: ArchiveLimits = DEFAULT_LIMITS) -> tuple[Scene, list[str]]:
    """The scene in an archive, and the warnings that it travels with.

    Raises:
        SceneInvalid: with every fault that the reading found.
    """
    try:
        files = read_archive(data, frozenset({JSON_NAME, ARRAYS_NAME}), limits)
        folder = single_folder(list(files), JSON_NAME)
        arrays_path = f"{folder}/{ARRAYS_NAME}".lstrip("/")
        if arrays_path not in files:
            raise ArchiveRefused(f"holds no {ARRAYS_NAME} beside {JSON_NAME}")
    except ArchiveRefused as error:
        raise refused("archive", str(error)) from error

    def fetch(name: str) -> bytes | None:
        try:
            named = read_archive(data, frozenset({name.rpartition("/")[2]}), limits)
        except ArchiveRefused as error:
            raise refused(name, str(error)) from error
        return named.get(f"{folder}/{name}".lstrip("/"))

    return scene_from_files(files[f"{folder}/{JSON_NAME}".lstrip("/")], files[arrays_path], limits, fetch)


def scene_from_files(
    json_text: bytes, npz: bytes, limits: ArchiveLimits = DEFAULT_LIMITS, fetch: Fetch = lambda name: None
) -> tuple[Scene, list[str]]:
    """The scene in the contents of ``scene.json`` and ``scene.npz``, and its warnings.

    Args:
        json_text, npz: the two files.
        limits: of what the arrays may hold.
        fetch: reads a further file of the bundle, for the meshes of colliders.

    Raises:
        SceneInvalid: with every fault that the reading found.
    """
    declared, faults = parse_json(json_text)
    arrays: dict[str, Array] = {}
    try:
        arrays = read_arrays(npz, limits)
    except ArchiveRefused as error:
        faults.append(FieldError(loc=[ARRAYS_NAME], msg=str(error)))
    if faults:
        raise SceneInvalid(faults)
    meshes, unread = fetch_meshes(declared, fetch)
    faults, warnings = check_scene(declared, arrays, meshes)
    if unread or faults:
        raise SceneInvalid(unread + faults)
    return scene_from_parts(declared, arrays, meshes), warnings


def validate(scene: Scene) -> tuple[list[FieldError], list[str]]:
    """Faults and warnings of a scene in memory, by the same checks as a bundle's."""
    return check_scene(*parts_of(scene), meshes_of(scene))


def checked(scene: Scene) -> tuple[Scene, list[str]]:
    """The scene and its warnings.

    Raises:
        SceneInvalid: with every fault.
    """
    faults, warnings = validate(scene)
    if faults:
        raise SceneInvalid(faults)
    return scene, warnings


def canonical_archive(scene: Scene) -> bytes:
    """The archive that this content, and no other, has: a stored zip of ``scene.json``, ``scene.npz`` and meshes.

    Reading it gives the scene back exactly, and writing that again gives the same bytes, on any machine.
    """
    buffer = io.BytesIO()
    write_archive(scene, buffer)
    return buffer.getvalue()


def write_archive(scene: Scene, stream: IO[bytes]) -> None:
    """Write the canonical archive to a stream that can seek; large arrays are copied to a temporary file on the way."""
    with tempfile.SpooledTemporaryFile(max_size=SPOOLED_BYTES) as arrays:
        size = _write_arrays(scene, arrays)
        files = [Member.of(name, content) for name, content in _files_beside(scene).items()]
        arrays.seek(0)
        whole = Member(ARRAYS_NAME, size, lambda entry: shutil.copyfileobj(arrays, entry, COPIED_BYTES))
        stream_zip([whole, *files], stream)


def write_bundle(scene: Scene, folder: Path | str) -> None:
    """Write ``scene.json``, ``scene.npz`` and the meshes of colliders into ``folder`` (made if absent)."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in _files_beside(scene).items():
        (folder / name).write_bytes(content)
    with (folder / ARRAYS_NAME).open("w+b") as stream:
        _write_arrays(scene, stream)


def scene_from_parts(
    declared: dict[str, Any], arrays: dict[str, Array], meshes: dict[str, SurfaceMesh] | None = None
) -> Scene:
    """A ``Scene`` out of parts that have passed the validator, or will (``checked``).

    Raises:
        SceneInvalid: the body's facts are not of their kinds.
    """
    fields: dict[str, Any] = {}
    try:
        body = _body(declared.get("body") or {})
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise refused("body", str(error)[:200]) from error
    for name, array in arrays.items():
        if name in FIELD_OF_ARRAY:
            fields[FIELD_OF_ARRAY[name]] = array if name in KEPT_AS_STORED else _float64(array)
    fields["visible"] = np.asarray(arrays["visible"]).astype(bool)
    fields["points"] = _without_gaps(fields["points"], fields["visible"])
    ground = declared.get("ground")
    return Scene(
        name=declared["name"],
        kind=declared["kind"],
        description=declared.get("description", ""),
        fps=float(declared["fps"]),
        gravity_m_s2=_float64(declared["gravity_m_s2"]),
        noise_sigma_m=_noise(declared, fields.get("noise_covariance_m2")),
        train=tuple(declared["split"]["train"]),
        test=tuple(declared["split"]["test"]),
        initial_state=_state(declared["initial_state"]),
        body=body,
        ground=None if ground is None else Ground(float(ground["height_m"]), _number(ground.get("friction"))),
        grips=tuple(_grip(grip) for grip in declared.get("grips") or []),
        colliders=colliders_of(declared, meshes or {}),
        extra_arrays={name: array for name, array in arrays.items() if name not in FIELD_OF_ARRAY},
        declared=declared,
        **fields,
    )


def _noise(declared: dict[str, Any], covariances: Array | None) -> float | None:
    """Deviation per axis [m]: that of the covariances where there are some, else what is declared."""
    return _number(declared.get("noise_sigma_m")) if covariances is None else sigma_of(covariances)


def parts_of(scene: Scene) -> tuple[dict[str, Any], dict[str, Array]]:
    """What ``scene.json`` and ``scene.npz`` hold for this scene: the fields over what was declared."""
    arrays = {
        name: np.asarray(getattr(scene, field))
        for name, field in FIELD_OF_ARRAY.items()
        if getattr(scene, field) is not None
    }
    clash = sorted(set(scene.extra_arrays) & set(FIELD_OF_ARRAY))
    if clash:
        raise ValueError(f"extra_arrays holds {', '.join(clash)}, which are fields of the scene")
    declared = copy.deepcopy(scene.declared)
    declared |= {
        "schema_version": SCHEMA_VERSION,
        "name": scene.name,
        "kind": scene.kind,
        "description": scene.description,
        "fps": float(scene.fps),
        "gravity_m_s2": _list(scene.gravity_m_s2),
        "noise_sigma_m": scene.noise_sigma_m,
        "split": {**declared.get("split", {}), "train": list(scene.train), "test": list(scene.test)},
        "initial_state": _state_text(scene.initial_state, declared.get("initial_state")),
        "body": _body_facts(scene.body, declared.get("body") or {}),
        "ground": _ground_facts(scene.ground, declared.get("ground") or {}),
        "grips": _grip_facts(scene.grips, declared.get("grips")),
    }
    if scene.colliders or "colliders" in declared:
        declared["colliders"] = collider_facts(scene) or None
    return declared, arrays | scene.extra_arrays


def _files_beside(scene: Scene) -> dict[str, bytes]:
    """The files of a bundle without its arrays."""
    text = json.dumps(parts_of(scene)[0], sort_keys=True, indent=1, allow_nan=False) + "\n"
    return {JSON_NAME: text.encode("ascii"), **mesh_files(scene)}


def _write_arrays(scene: Scene, stream: IO[bytes]) -> int:
    """Write the bundle's arrays; how many bytes they take."""
    stream_arrays({name: _stored(name, array) for name, array in parts_of(scene)[1].items()}, stream)
    return stream.seek(0, io.SEEK_END)


def _stored(name: str, array: Array) -> Array:
    """Little endian; measured doubles as float32 when that loses nothing."""
    if name in FIELD_OF_ARRAY and name not in CLOCKS and array.dtype == np.float64:
        narrow = np.empty(array.shape, dtype="<f4")
        rows = max(1, COPIED_VALUES // max(array[:1].size, 1))
        blocks = [slice(start, start + rows) for start in range(0, len(array), rows)]
        with np.errstate(over="ignore"):
            if all(_narrowed(array[block], narrow[block]) for block in blocks):
                return narrow
    return array.astype(array.dtype.newbyteorder("<"), copy=False)


def _narrowed(array: Array, narrow: Array) -> bool:
    """Write doubles into single precision of the same shape; whether that loses nothing."""
    narrow[...] = array
    return np.array_equal(narrow, array, equal_nan=True)


def _without_gaps(points: Array, visible: Array) -> Array:
    """Invisible values that are not numbers would spread through masked sums: the last seen one stands."""
    if np.isfinite(points).all():
        return points
    return np.where(np.isfinite(points), points, hold(points, visible))


def _state(text: str) -> str:
    return UNDEFORMED_AT_REST if text.startswith("undeformed") else AS_MEASURED


def _state_text(state: str, declared: str | None) -> str:
    if declared is not None and _state(declared) == state:
        return declared
    return UNDEFORMED_TEXT if state == UNDEFORMED_AT_REST else state


def _body(facts: dict[str, Any]) -> Body:
    topology = facts.get("topology") or {}
    edges, n = topology.get("edges"), topology.get("n")
    known: dict[str, Any] = {name: _number(facts.get(name)) for name in NUMBER_FACTS}
    known |= {name: None if facts.get(name) is None else _float64(facts[name]) for name in VECTOR_FACTS}
    return Body(
        **known,
        edges=None if edges is None else np.asarray(edges, dtype=np.int64).reshape(-1, 2),
        grid_shape=None if n is None else (n, n),
    )


def _body_facts(body: Body, declared: dict[str, Any]) -> dict[str, Any]:
    facts = dict(declared)
    known: dict[str, Any] = {name: _list(getattr(body, name)) for name in VECTOR_FACTS}
    known |= {name: getattr(body, name) for name in NUMBER_FACTS}
    for name, value in known.items():
        if value is not None or name in facts:
            facts[name] = value
    topology = dict(facts.get("topology") or {})
    edges = None if body.edges is None else body.edges.tolist()
    for name, value in (("edges", edges), ("n", None if body.grid_shape is None else body.grid_shape[0])):
        if value is not None or name in topology:
            topology[name] = value
    if topology:
        facts["topology"] = topology
    return facts


def _ground_facts(ground: Ground | None, declared: dict[str, Any]) -> dict[str, Any] | None:
    if ground is None:
        return None
    return {**declared, "height_m": ground.height_m, "friction": ground.friction}


def _grip(facts: dict[str, Any]) -> Grip:
    low, high = facts.get("region_min_m"), facts.get("region_max_m")
    return Grip(
        controllers=tuple(facts["controllers"]),
        region_min_m=None if low is None else _float64(low),
        region_max_m=None if high is None else _float64(high),
        points=tuple(facts.get("points") or ()),
        radius_m=None if facts.get("radius_m") is None else float(facts["radius_m"]),
        open_s=tuple((float(begin), float(end)) for begin, end in facts.get("open_s") or ()),
    )


def _grip_facts(grips: tuple[Grip, ...], declared: list[Any] | None) -> list[dict[str, Any]] | None:
    if not grips:
        return None
    same = declared if declared is not None and len(declared) == len(grips) else [{}] * len(grips)
    return [
        {
            **facts,
            "controllers": list(grip.controllers),
            "region_min_m": _list(grip.region_min_m),
            "region_max_m": _list(grip.region_max_m),
            "points": list(grip.points),
            **({} if grip.radius_m is None else {"radius_m": grip.radius_m}),
            **({} if not grip.open_s else {"open_s": [list(span) for span in grip.open_s]}),
        }
        for facts, grip in zip(same, grips, strict=True)
    ]


def _float64(values: Any) -> Array:
    return np.asarray(values, dtype=np.float64)


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _list(values: Array | None) -> list[float] | None:
    return None if values is None else _float64(values).tolist()
