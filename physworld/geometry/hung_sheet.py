"""A measured sheet that hangs from a bar: flat at the start, below the line of its controllers.

Trackers that fit a grid to the outline of a cloth move its nodes inwards at corners and edges, by 1 to 2 cm, and each
one by the same amount as long as the cloth is in view. So the nodes' places on the sheet are taken from where they are
while the grips stand still, not from the declared grid, and their distances from the plane are kept along the normal.
The noise of a first frame does not enter the shape, whose membrane would turn it into energy.

The sheet is a square of the declared side, its middle where the middle of the points' extents is; its upper edge is
held by a bar that moves with the controllers.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice, lattice_from_cells
from physworld.geometry.body import ReferenceBody, first_points
from physworld.scene import AS_MEASURED, Scene

_CELLS, _BUDGET, _FEWEST = 12, 2000, 6  # along a side at that budget, as its square root
_STILL = 0.007  # of the side: controllers that moved less stand still
_OFF_PLANE = 0.08  # of the side: rms distance of a flat sheet's points
_LEVEL = 0.2  # rise of the line of the controllers over its length
_SPAN = (0.8, 1.1)  # of the side, of that line
_EXTENT = (2.0, 98.0)  # percentiles between which points span the sheet
_EDGE = 0.6  # cells within which nodes belong to the held edge
_DOWN = np.array([0.0, 0.0, -1.0])


def hangs_from_a_bar(scene: Scene) -> bool:
    """Whether a scene shows a sheet of declared grid and side that hangs flat from two controllers at its corners."""
    grid, side = scene.body.grid_shape, scene.body.side_m
    if scene.initial_state != AS_MEASURED or grid is None or side is None or scene.grips:
        return False
    if scene.controllers.shape[1] != 2 or grid[0] * grid[1] != scene.points.shape[1]:
        return False
    line = scene.controllers[0, 1] - scene.controllers[0, 0]
    length = float(np.linalg.norm(line))
    if not _SPAN[0] * side < length < _SPAN[1] * side or abs(line @ _DOWN) > _LEVEL * length:
        return False
    local = _local(scene)
    below = np.ptp(local[:, 1]) > 0.5 * side and np.median(local[:, 1]) > 0.25 * side
    return bool(below and np.sqrt(np.mean(local[:, 2] ** 2)) < _OFF_PLANE * side)


def hung_sheet(scene: Scene, particle_budget: int, refinement: float) -> ReferenceBody:
    """The body of a scene of which :func:`hangs_from_a_bar` is true.

    Args:
        scene: the recording.
        particle_budget: about how many particles the sheet gets, a quarter of it.
        refinement: factor on the number of cells along a side.
    """
    side = scene.body.side_m
    assert side is not None
    count = round(refinement * max(_CELLS * np.sqrt(particle_budget / _BUDGET), _FEWEST))
    cells = np.stack(np.meshgrid(np.arange(count), np.arange(count), indexing="ij"), axis=-1).reshape(-1, 2)
    lattice = lattice_from_cells(np.zeros(2), np.full(2, side / count), cells, np.ones((len(cells), 4)))
    axes, local = _axes(scene), _local(scene)
    low, high = np.percentile(local[:, :2], _EXTENT, axis=0)
    corner = 0.5 * (low + high) - 0.5 * side
    rest = np.zeros((len(lattice.nodes), 3))
    rest[:, :2] = lattice.node_coordinates
    start = scene.control_track()[1][0].mean(axis=0) + (lattice.node_coordinates + corner) @ axes[:2]
    notes = [
        "it hangs flat from a bar along its upper edge; tracked points lie where they do while it is still"
    ]
    thickness = scene.body.thickness_m
    if thickness is None:
        thickness = 1e-3
        notes.append("thickness not declared: 1 mm assumed")
    return ReferenceBody(
        lattice,
        rest,
        start,
        np.zeros_like(start),
        local[:, :2] - corner,
        local[:, 2:],
        thickness,
        tuple(notes),
    )


def upper_edge(lattice: Lattice) -> Array:
    """Nodes that hold the upper edge of a hung sheet and its slope."""
    return np.flatnonzero(lattice.node_coordinates[:, 1] < _EDGE * lattice.spacing[1])


def _axes(scene: Scene) -> Array:
    """Along the bar, down, and their normal, (3, 3)."""
    controls = scene.control_track()[1][0]
    along = controls[1] - controls[0]
    along = along - _DOWN * (along @ _DOWN)
    along /= np.linalg.norm(along)
    return np.stack([along, _DOWN, np.cross(along, _DOWN)])


def _local(scene: Scene) -> Array:
    """Tracked points along :func:`_axes` from the middle of the controllers while these stand still [m], (N, 3)."""
    moved = np.linalg.norm(scene.controllers - scene.controllers[0], axis=2).max(axis=1)
    still = moved > _STILL * (scene.body.side_m or 1.0)
    end = max(int(np.argmax(still)) if still.any() else scene.train[1], 1)
    points = first_points(scene)
    for number in np.flatnonzero(scene.visible[:end].any(axis=0)):
        points[number] = np.median(scene.points[:end][scene.visible[:end, number], number], axis=0)
    local: Array = (points - scene.control_track()[1][0].mean(axis=0)) @ _axes(scene).T
    return local
