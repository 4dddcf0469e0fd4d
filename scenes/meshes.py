"""Meshes of colliders in a bundle: read from STL, OBJ, PLY or OFF, written as OFF with numbers that lose nothing.

Vertices are metres in the collider's own frame. Equal vertices are made one: a triangle soup such as STL then closes.
"""

from __future__ import annotations

import io

import numpy as np

from physworld.shapes.surface_mesh import SurfaceMesh, merged

MESH_SUFFIXES = ("stl", "obj", "ply", "off")
MAX_MESH_BYTES = 32 << 20
MAX_FACES = 200_000


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
        raise MeshRefused(
            f"{path} cannot be read as {suffix}: {type(error).__name__}: {str(error)[:200]}"
        ) from error
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
