"""A PLY file a frame: binary, little-endian, as MeshLab, Blender, Open3D and trimesh read point clouds.

``episode-00000/frame-00000.ply``. Vertices are the particles, then the control points; beside x, y, z [m] each has
``kind`` (0 particle, 1 control point) and the particle's log factors of stiffness and density, and of the ground's
friction under it where the episode has them. ``times.txt`` has the frames' times [s], ``attributes.json`` what else is
known of the episode, the strengths of its effects among it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from physworld_client.errors import ExportRefused
from physworld_client.export.properties import attributes_of, property_names
from physworld_client.export.sampling import spread_points
from physworld_client.types import Array

PLACE = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("kind", "u1")]
PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


class PlyWriter:
    """A folder an episode, a file a frame."""

    title: ClassVar[str] = "one PLY a frame"
    help: ClassVar[str] = (
        "episode-00000/frame-00000.ply: binary; x, y, z, kind (0 particle, 1 control point), log_modulus, log_density, "
        "and log_friction where the episode has it; times.txt; attributes.json"
    )

    def __init__(self, folder: Path, points: int | None = None) -> None:
        self._folder, self._points = folder, points
        self.unfinished: Path | None = None
        self._count = 0

    def add(self, index: int, arrays: Mapping[str, Array]) -> None:
        """Write one episode's frames."""
        particles, controllers = arrays["particles"], arrays["controllers"]
        chosen = spread_points(particles[0], self._points)
        names = property_names(arrays)
        vertices = np.zeros(
            len(chosen) + controllers.shape[1], dtype=[*PLACE, *((name, "<f4") for name in names)]
        )
        vertices["kind"][len(chosen) :] = 1
        for column, name in enumerate(names):
            vertices[name][: len(chosen)] = arrays["properties"][chosen, column]
        folder = self._folder / f"episode-{index:05d}"
        folder.mkdir()
        for frame in range(len(particles)):
            places = np.concatenate([particles[frame, chosen], controllers[frame]])
            for axis, name in enumerate("xyz"):
                vertices[name] = places[:, axis]
            (folder / f"frame-{frame:05d}.ply").write_bytes(ply_bytes(vertices))
        (folder / "attributes.json").write_text(json.dumps(attributes_of(arrays), indent=1))
        (folder / "times.txt").write_text("".join(f"{t!r}\n" for t in arrays["times"].tolist()))
        self._count += 1

    def finish(self) -> None:
        """Nothing is left to write. Raises ExportRefused where no episode was added."""
        if not self._count:
            raise ExportRefused("the dataset holds no episode")


def ply_bytes(vertices: Array) -> bytes:
    """A binary PLY of one element, ``vertex``, with the fields of a structured array (n,), ``PLACE`` and more."""
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
