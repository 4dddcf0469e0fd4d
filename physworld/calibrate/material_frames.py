"""Where material directions at the tracked points go in a run: what a shift of a point within the body moves it by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from physworld.arrays import Array
from physworld.twin.twin import Twin

_BESIDE = 0.1  # of a cell: how far beside a point its neighbours are followed


def material_frames(twin: Twin, carriers: Array) -> Array:
    """Where material directions point, (T, N, 3, 3): columns of the deformation gradient; a sheet's normal last.

    Carriers that are particles have no shape functions that last: neighbours of a point are followed instead.
    """
    lattice, points = twin.lattice, twin.body.points
    columns = []
    for axis in range(lattice.dim):
        if twin.form.on_particles:
            step = np.zeros(lattice.dim)
            step[axis] = _BESIDE * lattice.spacing[axis]
            ends = [
                replace(twin, body=replace(twin.body, points=points + sign * step)).track_nodes(carriers)
                for sign in (-1.0, 1.0)
            ]
            columns.append((ends[1] - ends[0]) / (2.0 * step[axis]))
        else:
            slope = lattice.interpolation(points, tuple(int(a == axis) for a in range(lattice.dim)))
            flat = carriers.transpose(1, 0, 2).reshape(carriers.shape[1], -1)
            columns.append((slope @ flat).reshape(len(points), len(carriers), 3).transpose(1, 0, 2))
    if lattice.dim == 2:
        normal = np.cross(*columns)
        columns.append(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
    return np.stack(columns, axis=-1)
