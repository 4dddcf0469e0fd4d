"""A PLY file a frame: binary, little-endian, as MeshLab, Blender, Open3D and trimesh read point clouds.

``episode-00000/frame-00000.ply``. Vertices are the particles, then the control points; beside x, y, z [m] each has
``kind`` (0 particle, 1 control point) and the particle's log factors of stiffness and density. ``times.txt`` has the
frames' times [s].
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from physworld_client.errors import ExportRefused
from physworld_client.export.sampling import spread_points

VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("kind", "u1"),
        ("log_modulus", "<f4"),
        ("log_density", "<f4"),
    ]
)
PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


class PlyWriter:
    """A folder an episode, a file a frame."""

    def __init__(self, folder: Path, points: int | None = None) -> None:
        self._folder, self._points = folder, points
        self._count = 0

    def add(self, index: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write one episode's frames."""
        particles, controllers = arrays["particles"], arrays["controllers"]
        chosen = spread_points(particles[0], self._points)
        vertices = np.zeros(len(chosen) + controllers.shape[1], dtype=VERTEX)
        vertices["kind"][len(chosen) :] = 1
        vertices["log_modulus"][: len(chosen)] = arrays["properties"][chosen, 0]
        vertices["log_density"][: len(chosen)] = arrays["properties"][chosen, 1]
        folder = self._folder / f"episode-{index:05d}"
        folder.mkdir()
        for frame in range(len(particles)):
            places = np.concatenate([particles[frame, chosen], controllers[frame]])
            for axis, name in enumerate("xyz"):
                vertices[name] = places[:, axis]
            (folder / f"frame-{frame:05d}.ply").write_bytes(ply_bytes(vertices))
        (folder / "times.txt").write_text("".join(f"{t!r}\n" for t in arrays["times"].tolist()))
        self._count += 1

    def finish(self) -> None:
        """Nothing is left to write. Raises ExportRefused where no episode was added."""
        if not self._count:
            raise ExportRefused("the dataset holds no episode")


def ply_bytes(vertices: np.ndarray) -> bytes:
    """A binary PLY of one element, ``vertex``, with the fields of a structured array (n,) of ``VERTEX``."""
    names = vertices.dtype.names or ()
    lines = [f"property {PLY_TYPES[vertices.dtype[name].str]} {name}" for name in names]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *lines,
        "end_header",
        "",
    ]
    return "\n".join(header).encode("ascii") + vertices.tobytes()
