"""The undeformed body of a scene: a solid, sheet or rod lattice and where its nodes are at the start.

- *Rod* (rope, rod): reference coordinate is the arc length s; rest lengths between markers, the declared length, or
  the measured polyline give s of every tracked point.
- *Sheet*: two in-plane coordinates from the declared grid, or from the plane of an undeformed flat sheet.
- *Solid* (everything else): reference coordinates are the world's at the start; a declared box, points that fill
  the body, or points that bound it.

Cell faces lie on the faces of boxes and where declared grips end (:mod:`physworld.geometry.alignment`).
At a solid's grip they lie 1/(2 sqrt 3) of a cell inside it: prescribing every node of the gripped cells also fixes the
slope at their face, which a solid's clamp does not, and so acts that much beyond it. With this the clamp is second
order in the cell size (``docs/verification.md``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice, lattice_from_cells
from physworld.engine.thin.triangles import Mesh
from physworld.errors import SceneUnsupported
from physworld.geometry.alignment import cells_along, faces_along
from physworld.geometry.body import ReferenceBody, first_points
from physworld.geometry.curves import fit_nodes, straight_extent
from physworld.geometry.declared import grips_of, load_of
from physworld.geometry.filling import filled_body, inside_surface_points
from physworld.geometry.rod_body import BRANCHED, rod_body
from physworld.geometry.sheet_body import SHEET_KINDS, THIN, plane_of, sheet_body
from physworld.scene import AS_MEASURED, Scene

ROD_KINDS = ("rope", "rod")
_ROD_CELLS = 32
_ROD_RADIUS_M = 0.004  # where none is declared or shown
_ON_AXIS = 1e-6  # of a straight rod's length: points so near its axis show no radius
_BOX_KINDS = ("beam", "block")
_CLAMP_REACH = 0.5 / np.sqrt(3.0)  # cells by which a held layer of splines acts beyond its face
_BOX_FILL = 0.93  # a cloud that fills this share of its bounding box is a box, whatever its kind


def reference_body(
    scene: Scene,
    particle_budget: int,
    refinement: float = 1.0,
    mesh: Mesh | None = None,
    discrete_rod: bool = False,
) -> ReferenceBody:
    """Build the body that the scene declares or shows.

    Args:
        scene: the recording.
        particle_budget: about how many particles a solid gets; the cells of a sheet's longer side go by its square
            root, 24 at 2000 and at least 12. Rods have 32 cells.
        refinement: cells are this many times smaller along every axis, whatever the body.
        mesh: of a sheet, the mesh of triangles that it is to be instead.
        discrete_rod: the body is a chain of edges (:mod:`physworld.geometry.rod_body`).

    Raises:
        SceneUnsupported: the scene shows or declares too little, with the missing key.
    """
    frames, count = scene.visible.shape
    if frames < 2 or not scene.visible.any():
        raise SceneUnsupported(
            f"{frames} frames with {count} points, {int(scene.visible.sum())} sightings in all: no motion to follow"
        )
    if discrete_rod and mesh is None:
        return rod_body(scene, refinement)
    if scene.kind in ROD_KINDS and mesh is None:
        return _rod(scene, refinement)
    if scene.kind == BRANCHED:
        raise SceneUnsupported(
            f"a branched cable of {count} points has no form but discrete_rod: a rod of splines has two ends"
        )
    if scene.kind in SHEET_KINDS:
        sheet = sheet_body(scene, particle_budget, refinement, mesh)
        if sheet is not None:
            return sheet
    if mesh is not None:
        raise SceneUnsupported(
            f"a body of kind {scene.kind}, or one that is not flat at the start, is no {mesh}"
        )
    return _solid(scene, round(particle_budget * refinement**3))


def _solid(scene: Scene, budget: int) -> ReferenceBody:
    points = first_points(scene)
    body = scene.body
    notes: list[str] = []
    if scene.kind in SHEET_KINDS:
        _, _, size, off_plane = plane_of(scene, points)
        notes.append(
            f"the sheet is not flat at the start ({off_plane:.3g} m rms off its plane, {size.min():.3g} m wide) and is "
            "taken as a solid"
        )
    test: Callable[[Array], Array] | None = None
    if body.box_min_m is not None and body.box_max_m is not None:
        low, high = body.box_min_m, body.box_max_m
        if np.any(high <= low):
            raise SceneUnsupported(f"the box from {low} to {high} m has no volume")
    else:
        cloud = scene.rest_volume_points
        if cloud is not None and len(cloud) >= 20:
            _require_volume(cloud, scene.kind)
            filled = filled_body(cloud)
            test, reach, volume = filled.contains, filled.reach_m, filled.volume_m3
        else:
            cloud = points if scene.surface_points is None else np.concatenate([points, scene.surface_points])
            if len(cloud) < 30:
                raise SceneUnsupported(
                    "; ".join([*notes, f"{len(cloud)} points do not bound a body of kind {scene.kind}"])
                    + ": declare body.box_min_m and body.box_max_m, or give rest_volume_points"
                )
            _require_volume(cloud, scene.kind)
            notes.append("the volume was filled from points on the surface")
            cell = float((np.prod(np.ptp(cloud, axis=0)) / budget) ** (1 / 3))
            test, reach = partial(inside_surface_points, cloud, cell=cell), 0.0
            probe = np.random.default_rng(0).uniform(cloud.min(axis=0), cloud.max(axis=0), size=(4000, 3))
            volume = float(test(probe).mean() * np.prod(np.ptp(cloud, axis=0)))

        low, high = cloud.min(axis=0), cloud.max(axis=0)
        share = min(volume / float(np.prod(high - low)), 1.0)
        if share >= _BOX_FILL or (scene.kind in _BOX_KINDS and share >= 0.7):
            test = None
            if body.size_m is not None and np.allclose(body.size_m, high - low, rtol=0.05):
                centre = 0.5 * (low + high)
                low, high = centre - 0.5 * body.size_m, centre + 0.5 * body.size_m
        else:
            notes.append(f"the body fills {share:.0%} of its bounding box")
            budget = int(budget / max(share, 0.05))
            low, high = low - reach, high + reach
    lattice = _solid_lattice(scene, low, high, test, budget)
    start = lattice.node_coordinates
    hanging = _hanging_mass(scene, lattice, notes)
    return ReferenceBody(
        lattice,
        start,
        start,
        np.zeros_like(start),
        points,
        np.zeros((len(points), 0)),
        0.0,
        tuple(notes),
        hanging,
    )


def _hanging_mass(scene: Scene, lattice: Lattice, notes: list[str]) -> Array | None:
    """The declared load on the nodes of a solid [kg], (n,)."""
    load = load_of(scene)
    if load is None:
        return None
    notes.append(f"a declared load of {load.mass_kg} kg hangs from it as a lumped mass")
    weights = lattice.interpolation(load.points)
    return np.asarray(weights.sum(axis=0)).reshape(-1) * (load.mass_kg / len(load.points))


def _require_volume(cloud: Array, kind: str) -> None:
    extent = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False)
    if extent[2] <= THIN * extent[0]:
        raise SceneUnsupported(
            f"{len(cloud)} points lie in a plane or on a line (principal extents {extent / np.sqrt(len(cloud))} m): "
            f"they span no volume for a {kind}"
        )


def _solid_lattice(
    scene: Scene, low: Array, high: Array, test: Callable[[Array], Array] | None, budget: int
) -> Lattice:
    size = np.maximum(high - low, 1e-9)
    cell = float((8 * np.prod(size) / budget) ** (1 / 3))
    grips = grips_of(scene)
    along = [
        cells_along(low[a], high[a], cell, faces_along(a, low, high, grips), _CLAMP_REACH) for a in range(3)
    ]
    origin, spacing = np.array(along).T
    counts = np.ceil((high - origin) / spacing - 1e-6).astype(int)
    cells = np.stack(np.meshgrid(*[np.arange(c) for c in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    fill = _box_fill(cells, origin, spacing, low, high)
    if test is not None:
        fill *= _sampled_fill(cells, origin, spacing, test)
    present = fill.max(axis=1) > 0.25
    if not present.any():
        raise SceneUnsupported(f"no cell of {spacing} m holds material between {low} and {high}")
    return lattice_from_cells(origin, spacing, cells[present], np.clip(fill[present], 0.0, 1.0))


def _octants(cells: Array) -> Array:
    """Lower corners of every cell's 8 octants in cell units, (C, 8, 3), in the order of the particles."""
    corner = np.stack(np.meshgrid([0, 0.5], [0, 0.5], [0, 0.5], indexing="ij"), axis=-1).reshape(8, 3)
    corners: Array = cells[:, None, :] + corner[None]
    return corners


def _box_fill(cells: Array, origin: Array, spacing: Array, low: Array, high: Array) -> Array:
    begin = origin + _octants(cells) * spacing
    overlap = np.minimum(begin + 0.5 * spacing, high) - np.maximum(begin, low)
    fill: Array = np.prod(np.clip(overlap / (0.5 * spacing), 0.0, 1.0), axis=2)
    return fill


def _sampled_fill(cells: Array, origin: Array, spacing: Array, test: Callable[[Array], Array]) -> Array:
    inner = np.stack(np.meshgrid(*[[0.125, 0.375]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    samples = origin + (_octants(cells)[:, :, None, :] + inner[None, None]) * spacing
    fill: Array = test(samples.reshape(-1, 3)).reshape(len(cells), 8, 8).mean(axis=2)
    return fill


def _rod(scene: Scene, refinement: float) -> ReferenceBody:
    points = first_points(scene)
    notes: list[str] = []
    if scene.initial_state != AS_MEASURED and len(points) > 3:
        cloud = points if scene.rest_volume_points is None else scene.rest_volume_points
        centre = cloud.mean(axis=0)
        direction = np.linalg.svd(cloud - centre, full_matrices=False)[2][0]
        if len(scene.controllers[0]) and np.dot(scene.controllers[0].mean(axis=0) - centre, direction) > 0:
            direction = -direction
        along = (cloud - centre) @ direction
        begin, length = straight_extent(scene, along, centre, direction, notes)
        arc = (points - centre) @ direction - begin
        base = centre + begin * direction
        off_axis = float(np.sqrt(np.mean(np.sum((cloud - centre - along[:, None] * direction) ** 2, axis=1))))
        radius = scene.body.radius_m or float(np.sqrt(2.0) * off_axis)
        if scene.body.radius_m is None and radius <= _ON_AXIS * length:
            radius = _ROD_RADIUS_M
            notes.append(f"radius not declared: {radius} m assumed (only bending over mass matters)")
        lattice = _rod_lattice(scene, length, (scene.controllers[0] - base) @ direction, refinement)
        start = base + lattice.node_coordinates * direction
        velocity = np.zeros_like(start)
    else:
        arc, length = _marker_arc_lengths(scene, points)
        radius = scene.body.radius_m or _ROD_RADIUS_M
        if scene.body.radius_m is None:
            notes.append(f"radius not declared: {radius} m assumed (only bending over mass matters)")
        nearest = np.argmin(np.linalg.norm(scene.controllers[0][:, None] - points[None], axis=2), axis=1)
        lattice = _rod_lattice(
            scene,
            length,
            arc[nearest] if scene.body.segment_rest_lengths_m is not None else [0.0],
            refinement,
        )
        start, velocity = fit_nodes(scene, lattice, arc[:, None])
        notes.append("the rest shape is taken as straight")
    rest = np.zeros((len(lattice.nodes), 3))
    rest[:, 0] = lattice.node_coordinates[:, 0]
    offsets = points - lattice.interpolation(arc[:, None]) @ start
    return ReferenceBody(lattice, rest, start, velocity, arc[:, None], offsets, radius, tuple(notes))


def _marker_arc_lengths(scene: Scene, points: Array) -> tuple[Array, float]:
    lengths = scene.body.segment_rest_lengths_m
    if lengths is not None:
        if len(lengths) != len(points) - 1:
            raise SceneUnsupported(
                f"{len(lengths)} segment rest lengths for {len(points)} tracked points; a chain needs one fewer"
            )
        arc = np.concatenate([[0.0], np.cumsum(lengths)])
        return arc, float(arc[-1])
    if not len(scene.controllers[0]):
        raise SceneUnsupported(
            f"nothing orders the {len(points)} points of a {scene.kind} without controllers: declare "
            "body.segment_rest_lengths_m"
        )
    anchor = scene.controllers[0].mean(axis=0)
    order = np.argsort(np.linalg.norm(points - anchor, axis=1))
    steps = np.linalg.norm(np.diff(np.concatenate([anchor[None], points[order]]), axis=0), axis=1)
    arc = np.empty(len(points))
    arc[order] = np.cumsum(steps)
    return arc, max(float(scene.body.length_m or 0.0), float(arc.max()))


def _rod_lattice(scene: Scene, length: float, grip_arcs: Array | list[float], refinement: float) -> Lattice:
    if not length > 0:
        raise SceneUnsupported(f"the tracked points of the {scene.kind} span {length} m: no length")
    grips = np.clip(np.atleast_1d(grip_arcs), 0.0, length)
    left = grips[grips < 0.5 * length]
    face = float(left.max()) if len(left) else 0.0
    right = grips[grips >= 0.5 * length]
    free = (float(right.min()) if len(right) else length) - face
    count = max(4, round(refinement * _ROD_CELLS * free / length))
    spacing = free / count
    origin = face - np.ceil(face / spacing - 1e-6) * spacing
    cells = np.arange(int(np.ceil((length - origin) / spacing - 1e-6)))[:, None]
    begin = origin + (cells + np.array([0.0, 0.5])[None]) * spacing
    fill = np.clip(
        (np.minimum(begin + 0.5 * spacing, length) - np.maximum(begin, 0.0)) / (0.5 * spacing), 0.0, 1.0
    )
    return lattice_from_cells(np.array([origin]), np.array([spacing]), cells, fill)
