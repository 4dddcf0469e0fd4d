"""Colliders between ``scene.json``, the mesh files beside it, and ``Scene``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from physworld.scene import DeclaredCollider, Scene
from physworld.shapes.surface_mesh import SurfaceMesh
from physworld_scenes.meshes import MeshRefused, mesh_path_fault, read_mesh, write_mesh
from physworld_schemas.base import FieldError

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
