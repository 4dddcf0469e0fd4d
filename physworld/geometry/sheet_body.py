"""The undeformed body of a sheet: its plane, its lattice or its mesh, and where its nodes are at the start."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice, lattice_from_cells
from physworld.engine.thin.triangles import Mesh, triangle_lattice
from physworld.errors import SceneUnsupported
from physworld.geometry.alignment import cells_along, faces_along
from physworld.geometry.body import ReferenceBody, first_points
from physworld.geometry.curves import fit_nodes
from physworld.geometry.declared import grips_of
from physworld.geometry.hung_sheet import hangs_from_a_bar, hung_sheet
from physworld.geometry.shown import cloud_of_start, reach_along, spacing_of
from physworld.scene import Grip, Scene

SHEET_KINDS = ("sheet", "cloth")
THIN = 1e-4  # points whose extent falls below this share of their largest one span a dimension less
_CELLS, _BUDGET = 24, 2000  # along the longer side at that budget, as its square root
_FEWEST_CELLS = 12
_LEAST_CELLS = 3  # along an edge of a lattice
_ALONG_AXES = 0.999  # cosine above which a sheet's edge lies along an axis of the world
_LEAST_FILL = 0.05  # cells of a sheet that hold less are left out
_DIGITS = 9  # of a fill: a full cell is full
_FLAT = 0.08  # a sheet's points lie within this share of its width of their plane (root mean square)
_TIGHTER = 0.97  # a sheet is turned in its plane if that shrinks its bounding rectangle below this share
_AS_DECLARED = 0.05  # share by which extents of points may miss the declared size


def sheet_body(
    scene: Scene, particle_budget: int, refinement: float, mesh: Mesh | None = None
) -> ReferenceBody | None:
    """The body of a scene of a sheet, as a mesh if one is given; None if it is not flat at the start.

    Args:
        scene: of a sheet or a cloth.
        particle_budget: about how many particles the sheet gets.
        refinement: factor on the number of cells along a side.
        mesh: cells of triangles in the place of splines, or None.

    Raises:
        SceneUnsupported: its points span no area; or a mesh is given of a sheet that is declared as a grid.
    """
    if is_hung_sheet(scene, mesh):
        return hung_sheet(scene, particle_budget, refinement)
    points = first_points(scene)
    notes: list[str] = []
    thickness = scene.body.thickness_m
    if thickness is None and scene.body.size_m is not None:
        thickness = float(np.min(scene.body.size_m))
    if thickness is None:
        thickness = 1e-3
        notes.append("thickness not declared: 1 mm assumed (only stiffness over mass matters)")
    grid = scene.body.grid_shape
    if grid is not None and scene.body.side_m is not None and grid[0] * grid[1] == len(points):
        side = scene.body.side_m
        first, second = np.meshgrid(
            np.linspace(0, side, grid[0]), np.linspace(0, side, grid[1]), indexing="ij"
        )
        material = np.stack([first.ravel(), second.ravel()], axis=1)
        size = np.array([side, side])
        flat_map = None
    else:
        origin, axes, size, off_plane = plane_of(scene, points)
        if off_plane > _FLAT * size.min():
            return None
        origin, size = _as_shown(scene, origin, axes, size)
        material = ((points - origin) @ axes.T)[:, :2]
        flat_map = (origin, axes)
    lattice: Lattice
    if mesh is not None:
        if flat_map is None:
            raise SceneUnsupported(
                f"a mesh of {mesh} starts flat and undeformed; this sheet, a grid of {grid} points, starts as measured"
            )
        begin, sides = _declared_extent(scene, flat_map, size)
        lattice = triangle_lattice(sides, mesh, begin)
        notes.append(f"a mesh as other engines take it: {mesh}")
        if sides is size:
            notes.append(
                f"its sides are what the points span, {size} m: no size is declared that agrees with them"
            )
    else:
        along = max(_CELLS * np.sqrt(particle_budget / _BUDGET), _FEWEST_CELLS)
        cell = max(float(size.max()) / (refinement * along), 1e-4)
        lattice = sheet_lattice(size, cell, grips_in_plane(scene, flat_map))
    rest = np.zeros((len(lattice.nodes), 3))
    rest[:, :2] = lattice.node_coordinates
    if flat_map is not None:
        start = flat_map[0] + lattice.node_coordinates @ flat_map[1][:2]
        velocity = np.zeros_like(start)
        offsets = ((points - flat_map[0]) @ flat_map[1][2])[:, None]
    else:
        start, velocity = fit_nodes(scene, lattice, material)
        offsets = np.zeros((len(points), 1))
    return ReferenceBody(lattice, rest, start, velocity, material, offsets, thickness, tuple(notes))


def is_hung_sheet(scene: Scene, mesh: Mesh | None = None) -> bool:
    """Whether the body of a scene is a sheet that hangs from a bar (:mod:`physworld.geometry.hung_sheet`)."""
    return mesh is None and scene.kind in SHEET_KINDS and hangs_from_a_bar(scene)


def _grip_faces(scene: Scene, flat_map: tuple[Array, Array] | None) -> Array:
    """Where the declared grips end along both axes of a sheet [m], (F, 2)."""
    boxes = [(grip.region_min_m, grip.region_max_m) for grip in grips_in_plane(scene, flat_map)]
    return np.array(boxes, dtype=float).reshape(-1, 2)


def _declared_extent(scene: Scene, flat_map: tuple[Array, Array] | None, size: Array) -> tuple[Array, Array]:
    """Lower corner (2,) and sides (2,) [m] as declared, where the points' extents ``size`` (2,) agree; else these.

    Points seldom lie on the edges, so an edge is where a grip ends beside one; without such a grip the middles agree.
    """
    declared = scene.body.size_m
    if declared is None or flat_map is None:
        return np.zeros(2), size
    sides = np.abs(flat_map[1][:2]) @ np.asarray(declared, dtype=float)
    if not np.allclose(sides, size, rtol=_AS_DECLARED):
        return np.zeros(2), size
    begin = 0.5 * (size - sides)
    faces = _grip_faces(scene, flat_map)
    for axis in range(2):
        low = faces[np.abs(faces[:, axis] - begin[axis]) < _AS_DECLARED * sides[axis], axis]
        high = faces[np.abs(faces[:, axis] - begin[axis] - sides[axis]) < _AS_DECLARED * sides[axis], axis]
        ends = np.concatenate([low, high - sides[axis]])
        if len(ends):
            begin[axis] = ends[np.argmin(np.abs(ends - begin[axis]))]
    return begin, sides


def _as_shown(scene: Scene, origin: Array, axes: Array, size: Array) -> tuple[Array, Array]:
    """Corner (3,) and sides (2,) [m] by the cloud of the first frame, as given where there is none.

    Args:
        origin, axes, size: of :func:`plane_of`.
    """
    cloud = cloud_of_start(scene)
    if cloud is None:
        return origin, size
    declared = scene.body.size_m
    sides = None if declared is None else np.abs(axes[:2]) @ np.asarray(declared, dtype=float)
    places, held = (cloud - origin) @ axes.T, (scene.controllers[0] - origin) @ axes[:2].T
    spacing = spacing_of(cloud)
    near = np.abs(places[:, 2]) < _FLAT * size.min()
    across, along = (
        reach_along(places[near, axis], None if sides is None else float(sides[axis]), held[:, axis], spacing)
        for axis in range(2)
    )
    if across is None or along is None:
        return origin, size
    return origin + np.array([across[0], along[0]]) @ axes[:2], np.array([across[1], along[1]])


def plane_of(scene: Scene, points: Array) -> tuple[Array, Array, Array, float]:
    """Corner (3,), axes (3, 3), the last one normal, and sides (2,) of a sheet's plane; rms distance from it [m]."""
    cloud = points if scene.rest_volume_points is None else scene.rest_volume_points
    centre = cloud.mean(axis=0)
    _, extents, axes = np.linalg.svd(cloud - centre, full_matrices=len(cloud) < 3)
    if np.abs(axes[2]).max() > 0.999:  # a sheet in a coordinate plane: keep its edges along the axes
        normal_axis = int(np.argmax(np.abs(axes[2])))
        axes = np.stack([*(np.eye(3)[a] for a in range(3) if a != normal_axis), np.eye(3)[normal_axis]])
        if np.linalg.det(axes) < 0:
            axes[2] = -axes[2]
    local = (cloud - centre) @ axes.T
    size = np.ptp(local[:, :2], axis=0)
    if size.min() <= THIN * size.max():
        raise SceneUnsupported(f"{len(cloud)} points of a {scene.kind} span {size} m: no area")
    if extents[1] <= THIN * extents[0]:
        raise SceneUnsupported(f"{len(cloud)} points of a {scene.kind} span {size} m on a line: no area")
    turn = _tightest_turn(local[:, :2])
    axes = np.concatenate([turn @ axes[:2], axes[2:]])
    local = (cloud - centre) @ axes.T
    size = np.ptp(local[:, :2], axis=0)
    return centre + local[:, :2].min(axis=0) @ axes[:2], axes, size, float(np.sqrt(np.mean(local[:, 2] ** 2)))


def _tightest_turn(plane: Array) -> Array:
    """Rotation (2, 2) after which points (M, 2) fill their bounding rectangle best: the principal axes of a square
    sheet are arbitrary. None is needed where it would gain less than a few percent.
    """
    corners = plane[ConvexHull(plane).vertices]
    sides = np.roll(corners, -1, axis=0) - corners
    angle = np.concatenate([[0.0], np.arctan2(sides[:, 1], sides[:, 0])])
    angle = (angle + np.pi / 4) % (np.pi / 2) - np.pi / 4
    turns = np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], axis=1).reshape(-1, 2, 2)
    areas = np.prod(np.ptp(np.einsum("kij,mj->kmi", turns, corners), axis=1), axis=1)
    return turns[np.argmin(areas)] if areas.min() < _TIGHTER * areas[0] else np.eye(2)


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
    low, asked = np.zeros(2), np.minimum(cell, size / _LEAST_CELLS)
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
