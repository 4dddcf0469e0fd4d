"""From points to volume: is a place inside the body that a point cloud fills or bounds?

Points that fill a body: an alpha shape, the Delaunay tetrahedra whose circumsphere is no larger than a few point
distances (Edelsbrunner, Muecke 1994). Strewn points stop short of the surface, so the shape is too small, by 10 to 20 %
for a few thousand points. It is grown by a share of the distance between points, as large as that is about each place
of the surface. Which share: where every point stands for the same volume, the tetrahedra around the points deep inside
show how much that is, and the shape is grown until it holds as much as its points stand for. With few points, or where
they lie closer in one part than in another, that volume is itself uncertain; then the share is drawn towards the usual
one, measured on strewn balls, boxes and tori.

Points that only bound a body: a voxel shell that closes around a core; within the shell the planes through neighbouring
points are the surface. An open surface stays a shell one voxel thick.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_fill_holes, distance_transform_edt, gaussian_filter, map_coordinates
from scipy.spatial import Delaunay, cKDTree

from physworld.arrays import Array

_ALPHA = 2.5  # circumradius limit in point distances
_DEEP = 1.0  # points this many distances inside the shape show the volume of one point
_FEW = 50  # with fewer such points the usual growth is taken; and as many show how close points lie about a place
_USUAL_GROWTH, _USUAL_SPREAD = (
    0.31,
    0.04,
)  # point distances that randomly strewn points stop short of a surface
_MOST_GROWTH = 0.6
_PROBES = 30_000
_TRIANGLE_STEP = 0.25  # the shape's surface is sampled at this share of the point distance
_MOST_VOXELS = 100  # along the longest side of a surface
_CLOSED = 0.6  # a shell that encloses this share of the most that any does has no leak
_POCKET = 0.05  # less than this share of the voxels enclosed is a pocket in an open surface
_NEIGHBOURS = 12  # points that show the plane of a surface
_EIGHTH = 1.27  # distance of the eighth neighbour in mean point distances (1.24 strewn, 1.41 on a grid)


@dataclass(frozen=True, eq=False)
class FilledBody:
    """The body that a cloud of points fills.

    Attributes:
        mesh: Delaunay tetrahedra of the points.
        kept: which of them belong to the shape, bool.
        surface: samples of the shape's boundary.
        distances: of points about each of them [m].
        growth: how far around the shape material still lies, in these distances.
        volume_m3: what the points stand for.
    """

    mesh: Delaunay
    kept: Array
    surface: cKDTree
    distances: Array
    growth: float
    volume_m3: float

    @property
    def reach_m(self) -> float:
        """The farthest from the shape that material lies [m]."""
        return self.growth * float(self.distances.max())

    def contains(self, query: Array) -> Array:
        """Which of ``query`` (Q, 3) lie inside, (Q,) bool."""
        inside = self._inside_shape(query)
        inside[~inside] = self._gaps(query[~inside]) <= self.growth
        return inside

    def _gaps(self, query: Array) -> Array:
        """How far from the shape's boundary places (Q, 3) are, in distances of points there, (Q,)."""
        gap, nearest = self.surface.query(query)
        found: Array = gap / self.distances[nearest]
        return found

    def _inside_shape(self, query: Array) -> Array:
        found = self.mesh.find_simplex(query)
        inside: Array = (found >= 0) & self.kept[np.maximum(found, 0)]
        return inside


def median_spacing(points: Array) -> float:
    """Median distance of a point to its nearest other point [m]; (M, 3) with M >= 2."""
    distance, _ = cKDTree(points).query(points, k=2)
    return float(np.median(distance[:, 1]))


def filled_body(points: Array) -> FilledBody:
    """The body that ``points`` (M, 3) fill; M >= 10, not all in a plane."""
    spacing = float(np.median(cKDTree(points).query(points, k=9)[0][:, 8])) / _EIGHTH
    mesh = Delaunay(points)
    edges = points[mesh.simplices][:, 1:] - points[mesh.simplices][:, :1]
    squares = np.sum(edges**2, axis=2)
    determinant = np.linalg.det(edges)
    flat = np.abs(determinant) < 1e-12 * np.maximum(squares.max(axis=1), 1e-30) ** 1.5
    safe = np.where(flat[:, None, None], np.eye(3), edges)
    centre = np.linalg.solve(safe, squares[..., None])[..., 0]
    radius = 0.5 * np.where(flat, np.sqrt(squares.max(axis=1)), np.linalg.norm(centre, axis=1))
    kept = radius <= _ALPHA * spacing
    volumes = np.where(kept, np.abs(determinant) / 6.0, 0.0)
    boundary = _boundary_samples(points, mesh, kept, _TRIANGLE_STEP * spacing)
    middles, solid = points[mesh.simplices[kept]].mean(axis=1), volumes[kept]
    sizes = [np.cbrt(_mean_about(middles, solid, places)) for places in (boundary, points)]
    distances = sizes[0] * (spacing / max(float(np.median(sizes[1])), 1e-30))
    shape = FilledBody(mesh, kept, cKDTree(boundary), distances, 0.0, float(volumes.sum()))
    deep = shape._gaps(points) > _DEEP
    if deep.sum() < _FEW:
        return _grown(shape, points, None)
    share = np.zeros(len(points))
    np.add.at(share, mesh.simplices, np.repeat(volumes[:, None] / 4.0, 4, axis=1))
    own, count = share[deep], len(points)
    by_chance = own.var() / _FEW
    uneven = _mean_about(points[deep], own, points[deep]).var() - 2.0 * by_chance
    error = float(np.sqrt(own.var() / len(own) + max(float(uneven), 0.0)))
    return _grown(shape, points, (count * float(own.mean()), count * error))


def _mean_about(places: Array, values: Array, query: Array) -> Array:
    """Mean of the values (M,) of the nearest places (M, 3) to each of ``query`` (Q, 3), (Q,)."""
    near = cKDTree(places).query(query, k=min(_FEW, len(places)))[1]
    found: Array = values[near.reshape(len(query), -1)].mean(axis=1)
    return found


def inside_surface_points(points: Array, query: Array, cell: float) -> Array:
    """Which of ``query`` (Q, 3) lie inside the surface sampled by ``points`` (M, 3), at voxel size ``cell`` [m].

    Voxels of one and a half to seven point distances are tried, and the finest that closes is taken; the planes through
    neighbouring points then tell inside from outside. Where nothing closes, the body is the voxels of ``cell`` [m] that
    hold points.
    """
    finest = max(1.5 * median_spacing(points), float(np.ptp(points, axis=0).max()) / _MOST_VOXELS)
    grids = [_voxels(points, factor * finest) for factor in (1.0, 1.25, 1.6, 2.0, 2.5, 3.0, 4.0, 5.0)]
    closed = [
        float(core.sum()) * size**3 if core.sum() > _POCKET * filled.sum() else 0.0
        for core, filled, _, size in grids
    ]
    if max(closed) > 0.0:
        core, filled, low, size = grids[int(np.argmax(np.array(closed) >= _CLOSED * max(closed)))]
        return _inside_closed(points, query, (query - low) / size, (points - low) / size, core, filled)
    _, filled, low, size = _voxels(points, max(cell, finest))
    return _held(filled, (query - low) / size)


def _voxels(points: Array, size: float) -> tuple[Array, Array, Array, float]:
    """Voxels that the points enclose, those with what they lie in, the corner of the first [m], and their size [m]."""
    low = points.min(axis=0) - 2 * size
    shape = np.ceil((points.max(axis=0) + 2 * size - low) / size).astype(int) + 1
    shell = np.zeros(shape, dtype=bool)
    shell[tuple(((points - low) / size).astype(int).T)] = True
    filled = binary_fill_holes(shell)
    return filled & ~shell, filled, low, size


def _held(voxels: Array, places: Array) -> Array:
    """Which of ``places`` (Q, 3), in voxels, lie in one that is true."""
    index = np.floor(places).astype(int)
    within = np.all((index >= 0) & (index < voxels.shape), axis=1)
    held: Array = within & voxels[tuple(np.clip(index, 0, np.array(voxels.shape) - 1).T)]
    return held


def _inside_closed(
    points: Array,
    query: Array,
    query_voxels: Array,
    point_voxels: Array,
    core: Array,
    filled: Array,
) -> Array:
    """Inside of a closed shell: the core, and of the shell what lies on the core's side of the points' planes."""
    tree = cKDTree(points)
    _, near = tree.query(points, k=min(_NEIGHBOURS, len(points)))
    local = points[near] - points[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("mki,mkj->mij", local, local))[1][:, :, 0]
    outwards = gaussian_filter(distance_transform_edt(~core) - distance_transform_edt(filled), 1.0)
    slope = np.stack(
        [
            map_coordinates(part, point_voxels.T - 0.5, order=1, mode="nearest")
            for part in np.gradient(outwards)
        ],
        axis=1,
    )
    normals[np.sum(normals * slope, axis=1) < 0] *= -1
    inside = _held(core, query_voxels)
    doubtful = _held(filled & ~core, query_voxels)
    gap, near = tree.query(query[doubtful], k=min(4, len(points)))
    weight = 1.0 / np.maximum(gap, 1e-12)
    height = np.einsum("qki,qki->qk", query[doubtful][:, None] - points[near], normals[near])
    inside[doubtful] = np.sum(weight * height, axis=1) <= 0.0
    return inside


def _grown(shape: FilledBody, points: Array, estimate: tuple[float, float] | None) -> FilledBody:
    """The shape grown to an estimated volume and error [m^3], as far as these beat the usual growth."""
    query, each = _probes(points, _MOST_GROWTH * float(shape.distances.max()))
    gap = np.sort(shape._gaps(query[~shape._inside_shape(query)]))
    growth = _USUAL_GROWTH
    if estimate is not None:
        volume, error = estimate
        wanted = gap[np.clip(round((volume - shape.volume_m3) / each), 0, len(gap) - 1)]
        added = each * np.searchsorted(gap, _MOST_GROWTH) / _MOST_GROWTH
        trust = 1.0 / (1.0 + (error / added / _USUAL_SPREAD) ** 2)
        growth += trust * (float(np.clip(wanted, 0.0, _MOST_GROWTH)) - growth)
    held = shape.volume_m3 + each * float(np.searchsorted(gap, growth, side="right"))
    return replace(shape, growth=growth, volume_m3=held)


def _probes(points: Array, margin: float) -> tuple[Array, float]:
    """Places (Q, 3) spread over the box of the points and a margin [m] about it, and the volume of each [m^3]."""
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    query = np.random.default_rng(0).uniform(low, high, size=(_PROBES, 3))
    return query, float(np.prod(high - low)) / _PROBES


def _boundary_samples(points: Array, mesh: Delaunay, kept: Array, step: float) -> Array:
    """Points (S, 3) on the triangles between kept tetrahedra and everything else, no farther than ``step`` apart."""
    beyond = (mesh.neighbors < 0) | ~kept[np.maximum(mesh.neighbors, 0)]
    tetrahedron, opposite = np.nonzero(kept[:, None] & beyond)
    corners = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[opposite]
    triangles = points[np.take_along_axis(mesh.simplices[tetrahedron], corners, axis=1)]
    sides = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    pieces = np.maximum(np.ceil(sides / step).astype(int), 1)
    samples = [points[:0]]
    for count in np.unique(pieces):
        first, second = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        share = np.stack([first, second], axis=-1)[first + second <= count] / count
        weights = np.concatenate([1.0 - share.sum(axis=1, keepdims=True), share], axis=1)
        samples.append(np.einsum("sk,tki->tsi", weights, triangles[pieces == count]).reshape(-1, 3))
    return np.concatenate(samples) if len(triangles) else points
