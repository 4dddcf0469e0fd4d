"""The lattice of a sheet: over its two in-plane coordinates, with cell faces where its grips end."""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice, lattice_from_cells
from physworld.geometry.alignment import cells_along, faces_along
from physworld.geometry.declared import grips_of
from physworld.scene import Grip, Scene

_FEWEST_CELLS = 3
_ALONG_AXES = 0.999  # cosine above which a sheet's edge lies along an axis of the world
_LEAST_FILL = 0.05  # cells of a sheet that hold less are left out
_DIGITS = 9  # of a fill: a full cell is full


def grips_in_plane(scene: Scene, flat_map: tuple[Array, Array] | None) -> tuple[Grip, ...]:
    """The grips' boxes in the sheet's own two coordinates; none where its edges do not lie along the world's axes.

    Args:
        flat_map: corner (3,) and axes (3, 3) of the plane in which the sheet lies at the start; None: it is not flat.
    """
    if flat_map is None or np.abs(flat_map[1][:2]).max(axis=1).min() < _ALONG_AXES:
        return ()
    found = []
    for grip in grips_of(scene):
        if grip.region_min_m is not None and grip.region_max_m is not None:
            ends = (np.stack([grip.region_min_m, grip.region_max_m]) - flat_map[0]) @ flat_map[1][:2].T
            found.append(Grip(grip.controllers, ends.min(axis=0), ends.max(axis=0)))
    return tuple(found)


def sheet_lattice(size: Array, cell: float, grips: tuple[Grip, ...]) -> Lattice:
    """Cells of about ``cell`` [m] over a sheet from (0, 0) to ``size`` (2,) [m], at its edges filled in part.

    A thin sheet's clamp fixes its slope, as held splines do, so cell faces lie on the grips' own.
    """
    low, asked = np.zeros(2), np.minimum(cell, size / _FEWEST_CELLS)
    along = [cells_along(0.0, size[a], asked[a], faces_along(a, low, size, grips), 0.0) for a in range(2)]
    origin, spacing = np.array(along).T
    counts = np.ceil((size - origin) / spacing - 1e-6).astype(int)
    cells = np.stack(np.meshgrid(*[np.arange(c) for c in counts], indexing="ij"), axis=-1).reshape(-1, 2)
    corner = np.stack(np.meshgrid([0, 0.5], [0, 0.5], indexing="ij"), axis=-1).reshape(4, 2)
    begin = origin + (cells[:, None, :] + corner[None]) * spacing
    inside = np.minimum(begin + 0.5 * spacing, size) - np.maximum(begin, 0.0)
    fill = np.prod(np.clip(inside / (0.5 * spacing), 0.0, 1.0), axis=2).round(_DIGITS)
    present = fill.max(axis=1) > _LEAST_FILL
    return lattice_from_cells(origin, spacing, cells[present], fill[present])
