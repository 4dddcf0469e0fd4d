"""Colliders of a scene: their checks, their mesh files, and the way between ``scene.json`` and ``Scene``.

Meshes are read from STL, OBJ, PLY or OFF and written as OFF with numbers that lose nothing. Vertices are metres in the
collider's own frame. Equal vertices are made one: a triangle soup such as STL then closes.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.scene import DeclaredCollider, Scene
from physworld.shapes.surface_mesh import SurfaceMesh, merged
from physworld_scenes.declaration import ColliderForm, Declaration
from physworld_scenes.measured import Findings, Measured
from physworld_schemas.base import FieldError
from physworld_schemas.wording import reason

LARGEST_SIZES, SMALLEST_SIZES = 100.0, 0.01
"""Longest side of a collider over the object's size: a floor or a table at most, the tip of a needle at least."""

UNIT_TOLERANCE = 1e-3
"""How far the length of a quaternion may be from 1: rounding of written numbers, not another convention."""

FRICTION_WARNING = 2.0

Where = list[str | int]

MESH_SUFFIXES = ("stl", "obj", "ply", "off")
MAX_MESH_BYTES = 32 << 20
MAX_FACES = 200_000

Fetch = Callable[[str], bytes | None]
"""Content of a file of the bundle by its path beside ``scene.json``; None where there is none."""


def fetch_meshes(declared: dict[str, Any], fetch: Fetch) -> tuple[dict[str, SurfaceMesh], list[FieldError]]:
    """Meshes that the colliders name, by path, and the faults of those that cannot be had.

    Paths that lead out of the bundle are left to the validator; nothing is fetched for them.
    """
    meshes: dict[str, SurfaceMesh] = {}
    faults = []
    for number, path in _mesh_paths(declared):
        if path in meshes or mesh_path_fault(path) is not None:
            continue
        content = fetch(path)
        try:
            if content is None:
                raise MeshRefused(f"is {path!r}, which is not in the bundle")
            meshes[path] = read_mesh(path, content)
        except MeshRefused as error:
            faults.append(FieldError(loc=["scene.json", "colliders", number, "mesh"], msg=str(error)))
    return meshes, faults


def colliders_of(declared: dict[str, Any], meshes: dict[str, SurfaceMesh]) -> tuple[DeclaredCollider, ...]:
    """Colliders out of parts that have passed the validator."""
    return tuple(_collider(facts, meshes) for facts in declared.get("colliders") or [])


def collider_facts(scene: Scene) -> list[dict[str, Any]]:
    """What ``scene.json`` says of the scene's colliders, over what it said of them when it came."""
    before = scene.declared.get("colliders") or []
    same = before if len(before) == len(scene.colliders) else [{}] * len(scene.colliders)
    return [{**facts, **_facts(collider)} for facts, collider in zip(same, scene.colliders, strict=True)]


def meshes_of(scene: Scene) -> dict[str, SurfaceMesh]:
    """Meshes of the scene's colliders by the path that :func:`collider_facts` gives them."""
    return {_mesh_path(c): c.mesh for c in scene.colliders if c.mesh is not None}


def mesh_files(scene: Scene) -> dict[str, bytes]:
    """Their files."""
    return {path: write_mesh(mesh) for path, mesh in meshes_of(scene).items()}


def _mesh_paths(declared: dict[str, Any]) -> list[tuple[int, str]]:
    colliders = declared.get("colliders")
    if not isinstance(colliders, list):
        return []
    named = [(number, c.get("mesh")) for number, c in enumerate(colliders) if isinstance(c, dict)]
    return [(number, path) for number, path in named if isinstance(path, str)]


def _mesh_path(collider: DeclaredCollider) -> str:
    return f"{collider.name}.off"


def _collider(facts: dict[str, Any], meshes: dict[str, SurfaceMesh]) -> DeclaredCollider:
    def number(key: str) -> float | None:
        return None if facts.get(key) is None else float(facts[key])

    size = facts.get("size_m")
    return DeclaredCollider(
        name=facts["name"],
        shape=facts["shape"],
        size_m=None if size is None else np.asarray(size, dtype=float),
        radius_m=number("radius_m"),
        length_m=number("length_m"),
        mesh=meshes[facts["mesh"]] if facts["shape"] == "mesh" else None,
        friction=number("friction"),
        position_m=np.asarray(facts.get("position_m") or (0.0, 0.0, 0.0), dtype=float),
        quaternion_wxyz=np.asarray(facts.get("quaternion_wxyz") or (1.0, 0.0, 0.0, 0.0), dtype=float),
        controllers=tuple(facts.get("controllers") or ()),
        poses=facts.get("poses"),
    )


def _facts(collider: DeclaredCollider) -> dict[str, Any]:
    return {
        "name": collider.name,
        "shape": collider.shape,
        "size_m": None if collider.size_m is None else np.asarray(collider.size_m, dtype=float).tolist(),
        "radius_m": collider.radius_m,
        "length_m": collider.length_m,
        "mesh": None if collider.mesh is None else _mesh_path(collider),
        "friction": collider.friction,
        "position_m": np.asarray(collider.position_m, dtype=float).tolist(),
        "quaternion_wxyz": np.asarray(collider.quaternion_wxyz, dtype=float).tolist(),
        "controllers": list(collider.controllers),
        "poses": collider.poses,
    }


class MeshRefused(ValueError):
    """A mesh file that cannot be read, or is too large; the message says which and why."""


def mesh_path_fault(path: str) -> str | None:
    """Why ``path`` is no file inside of the bundle that could be a mesh; None where it is."""
    parts = path.split("/")
    if (
        "\\" in path
        or "\x00" in path
        or path.startswith("/")
        or path[1:2] == ":"
        or ".." in parts
        or "" in parts
    ):
        return f"is {path!r}, which is no path inside of the bundle"
    if path.rpartition(".")[2].lower() not in MESH_SUFFIXES:
        return f"is {path!r}; meshes are {', '.join(f'.{suffix}' for suffix in MESH_SUFFIXES)} files"
    return None


def read_mesh(path: str, content: bytes) -> SurfaceMesh:
    """The triangles in a file, looking outwards.

    Raises:
        MeshRefused: too large, damaged, or without triangles.
    """
    if len(content) > MAX_MESH_BYTES:
        raise MeshRefused(f"{path} has {len(content)} bytes, at most {MAX_MESH_BYTES} are read")
    import trimesh

    suffix = path.rpartition(".")[2].lower()
    try:
        loaded = trimesh.load_mesh(io.BytesIO(content), file_type=suffix, process=False)
        vertices, faces = (
            np.asarray(loaded.vertices, dtype=np.float64),
            np.asarray(loaded.faces, dtype=np.int64),
        )
    except Exception as error:
        raise MeshRefused(f"{path} cannot be read as {suffix}: {reason(error)[:200]}") from error
    if faces.ndim != 2 or not len(faces) or not len(vertices):
        raise MeshRefused(f"{path} holds no triangles ({len(vertices)} vertices)")
    if len(faces) > MAX_FACES:
        raise MeshRefused(f"{path} has {len(faces)} triangles, at most {MAX_FACES} are read")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshRefused(f"{path} names vertices {faces.min()} to {faces.max()} of {len(vertices)}")
    return merged(vertices, faces)


def write_mesh(mesh: SurfaceMesh) -> bytes:
    """The mesh as an OFF file; :func:`read_mesh` gives it back bit for bit."""
    lines = ["OFF", f"{len(mesh.vertices)} {len(mesh.faces)} 0"]
    lines += [" ".join(repr(float(number)) for number in vertex) for vertex in mesh.vertices]
    lines += ["3 " + " ".join(str(int(number)) for number in face) for face in mesh.faces]
    return ("\n".join(lines) + "\n").encode("ascii")


def check_colliders(
    declaration: Declaration,
    arrays: dict[str, Array],
    meshes: dict[str, SurfaceMesh],
    measured: Measured,
    object_size_m: float,
    findings: Findings,
) -> None:
    """All colliders of a declaration.

    Args:
        declaration: the form.
        arrays: those in ``scene.npz``.
        meshes: mesh files by their path in the bundle, those that could be read.
        measured: the arrays that agree.
        object_size_m: diagonal of the object.
        findings: where faults and warnings go.
    """
    names: set[str] = set()
    owner = {i: f"grip {g}" for g, grip in enumerate(declaration.grips or []) for i in grip.controllers}
    for number, collider in enumerate(declaration.colliders or []):
        where: Where = ["scene.json", "colliders", number]
        if collider.name in names:
            findings.fault([*where, "name"], f"is {collider.name!r}, as another collider's")
        names.add(collider.name)
        _check_size(collider, meshes, object_size_m, where, findings)
        _check_quaternions(np.array([collider.quaternion_wxyz]), [*where, "quaternion_wxyz"], findings)
        _check_carriers(collider, owner, measured.controllers.shape[1], where, findings)
        if collider.poses is not None:
            _check_poses(collider.poses, arrays, where, findings)
        if collider.friction is not None and collider.friction > FRICTION_WARNING:
            findings.warn([*where, "friction"], f"is {collider.friction:g}; rubber on rubber has about 1.2")


def _check_size(
    collider: ColliderForm,
    meshes: dict[str, SurfaceMesh],
    object_size_m: float,
    where: Where,
    findings: Findings,
) -> None:
    if collider.shape == "half_space":
        return
    if collider.shape == "mesh":
        path = collider.mesh or ""
        fault = mesh_path_fault(path)
        if fault is not None:
            findings.fault([*where, "mesh"], fault)
        if path not in meshes:
            return
        fault = meshes[path].fault()
        if fault is not None:
            findings.fault([*where, "mesh"], f"{path} {fault}")
            return
        longest, key = float(meshes[path].size_m.max()), "mesh"
    else:
        sizes = [2 * (collider.radius_m or 0.0), collider.length_m or 0.0, *(collider.size_m or ())]
        longest, key = max(sizes), "size_m" if collider.shape == "box" else "radius_m"
    if object_size_m <= 0.0:
        return
    factor = longest / object_size_m
    if not SMALLEST_SIZES <= factor <= LARGEST_SIZES:
        near = [f for f in (100.0, 1000.0) if 0.05 < factor / f < 20.0 or 0.05 < 1 / (factor * f) < 20.0]
        hint = f": do their units differ by {near[-1]:g}?" if near else ""
        findings.fault(
            [*where, key],
            f"is {longest:.4g} m long beside an object of {object_size_m:.4g} m, {factor:.3g} times{hint}",
        )


def _check_carriers(
    collider: ColliderForm, owner: dict[int, str], count: int, where: Where, findings: Findings
) -> None:
    place = [*where, "controllers"]
    if collider.controllers and collider.poses is not None:
        findings.fault(place, f"carry it, and so does the array {collider.poses!r}: one of the two")
    outside = [i for i in collider.controllers if i >= count]
    if outside:
        findings.fault(place, f"names {outside[:5]}, there are {count} (0 to {count - 1})")
    if len(set(collider.controllers)) != len(collider.controllers):
        findings.fault(
            place, f"names {len(collider.controllers) - len(set(collider.controllers))} of them twice"
        )
    for i in set(collider.controllers):
        if owner.setdefault(i, f"collider {collider.name!r}") != f"collider {collider.name!r}":
            findings.fault(place, f"names controller {i}, which {owner[i]} has")
    if len(collider.controllers) in (1, 2):
        findings.warn(place, f"are {len(collider.controllers)}: three or more show a full rotation")


def _check_poses(name: str, arrays: dict[str, Array], where: Where, findings: Findings) -> None:
    place = [*where, "poses"]
    poses = arrays.get(name)
    if poses is None:
        findings.fault(place, f"is {name!r}; scene.npz holds {', '.join(sorted(arrays))}")
        return
    lengths = {
        len(arrays["times"]),
        len(arrays["ctrl_times"]) if "ctrl_times" in arrays else len(arrays["times"]),
    }
    if (
        poses.ndim != 2
        or poses.shape[1] != 7
        or poses.shape[0] not in lengths
        or poses.dtype.kind not in "fiu"
    ):
        wanted = " or ".join(f"({length}, 7)" for length in sorted(lengths))
        findings.fault(place, f"{name} has shape {poses.shape} of {poses.dtype}, not {wanted}")
        return
    bad = ~np.isfinite(poses).all(axis=1)
    if bad.any():
        findings.fault(
            place, f"{name} is not finite in {int(bad.sum())} poses, first in {int(np.argmax(bad))}"
        )
        return
    _check_quaternions(np.asarray(poses[:, 3:], dtype=float), place, findings)


def _check_quaternions(quaternions: Array, where: Where, findings: Findings) -> None:
    lengths = np.linalg.norm(quaternions, axis=1)
    worst = int(np.argmax(np.abs(lengths - 1.0)))
    if not math.isclose(lengths[worst], 1.0, abs_tol=UNIT_TOLERANCE):
        findings.fault(
            where,
            f"has a quaternion {np.round(quaternions[worst], 4).tolist()} of length {lengths[worst]:.4g}, not 1",
        )
