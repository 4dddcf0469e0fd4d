"""Mass points of a body, the springs between them, and what holds them: the ground of both spring–mass baselines.

The points are those of the twin's own reference body, so that both baselines know as much of the shape as the twin:
quadrature points of a solid or of a sheet's middle surface; of a rope, whose points on a line would not resist
bending, four around every node of its axis, at its declared or assumed radius. All have the same mass, and rest lengths
are those of the first frame (Jiang et al. 2025; Zhong et al. 2024).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from physworld.arrays import Array
from physworld.engine.formulations import RODS
from physworld.engine.rods.chain import Chain
from physworld.errors import SceneUnsupported
from physworld.geometry.body import first_points
from physworld.geometry.rigid import rigid_motion
from physworld.geometry.rod_body import KINDS as ROPES
from physworld.scene import Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

AROUND = 4  # points around a node of a rope
_HELD_SHARE = 0.9  # of a point's material that lies on held nodes
_CARRIERS = 16  # mass points that carry a tracked point


@dataclass(frozen=True, eq=False)
class SpringBody:
    """See the module's text; positions are relative to ``origin``.

    Attributes:
        origin: middle of the points at the first frame [m], (3,).
        points, velocity: at the first frame [m], [m/s], (P, 3).
        spacing: longest edge of the points' minimum spanning tree [m]: springs of that reach leave nothing apart.
        held: numbers of the points that grips hold, (H,).
        knots: times of the control track [s], (Tc,).
        paths: places of the held points at the knots [m], (Tc, H, 3).
        carriers: mass points of each tracked point, (N, k).
        shares: their weights, rows sum to one, (N, k); with ``offsets`` (N, 3) [m] they give the first frame exactly.
        offsets: what the weights leave [m], (N, 3).
        gravity: (3,) [m/s²].
        ground: height of the ground relative to ``origin`` [m], or None.
        touches_itself: whether the scene declares that it does.
        start_s: until then the body is held as it starts [s].
    """

    origin: Array
    points: Array
    velocity: Array
    spacing: float
    held: Array
    knots: Array
    paths: Array
    carriers: Array
    shares: Array
    offsets: Array
    gravity: Array
    ground: float | None
    touches_itself: bool
    start_s: float

    def tracked(self, points: Array) -> Array:
        """Tracked points (T, N, 3) [m] in the world, of mass points (T, P, 3) [m]."""
        carried = np.einsum("nk,tnkx->tnx", self.shares, points[:, self.carriers])
        places: Array = carried + self.offsets + self.origin
        return places

    def pulled_back(self, gradient: Array) -> Array:
        """Gradient by the mass points, (T, P, 3), of one by the tracked points, (T, N, 3)."""
        found = np.zeros((len(self.points), len(gradient), 3))
        np.add.at(found, self.carriers, np.einsum("nk,tnx->nktx", self.shares, gradient))
        return found.transpose(1, 0, 2)

    def held_at(self, times: Array) -> Array:
        """Places of the held points at ``times`` (T,) [s], (T, H, 3) [m]; the last one for ever."""
        if len(self.knots) < 2:
            return np.repeat(self.paths[:1], len(times), axis=0)
        within = np.clip(times, self.knots[0], self.knots[-1])
        places: Array = PchipInterpolator(self.knots, self.paths, axis=0)(within)
        return places


def spring_body(scene: Scene, point_budget: int) -> SpringBody:
    """The mass points of a scene.

    Args:
        scene: the recording; only its first frame, its controllers and what it declares are looked at, and of
            points that were hidden there the training frames (:func:`physworld.geometry.body.first_points`).
        point_budget: about how many points a solid gets.

    Raises:
        SceneUnsupported: it declares too little for a body, or rigid bodies push it.
    """
    if scene.colliders:
        raise SceneUnsupported(
            f"{len(scene.colliders)} rigid bodies push it; the springs know a ground alone"
        )
    twin = build_twin(scene, point_budget, formulation=RODS.name if scene.kind in ROPES else "auto")
    points, velocity, groups = _mass_points(twin)
    origin = points.mean(axis=0)
    times, controls = scene.control_track()
    paths = [np.empty((len(times), 0, 3))]
    for controllers, held in zip(twin.controller_groups, groups, strict=True):
        turn, shift = rigid_motion(twin.controllers_start[controllers], controls[:, controllers])
        paths.append(np.einsum("tij,nj->tni", turn, points[held]) + shift[:, None] - origin)
    tracked = first_points(scene)
    near = cKDTree(points).query(tracked, k=min(_CARRIERS, len(points)))[1].reshape(len(tracked), -1)
    shares = np.stack([_affine(points[own], place) for own, place in zip(near, tracked, strict=True)])
    declared = scene.declared.get("body") or {}
    return SpringBody(
        origin=origin,
        points=points - origin,
        velocity=velocity,
        spacing=float(minimum_spanning_tree(squareform(pdist(points))).data.max()),
        held=np.concatenate([np.empty(0, dtype=int), *groups]),
        knots=times,
        paths=np.concatenate(paths, axis=1),
        carriers=near,
        shares=shares,
        offsets=tracked - np.einsum("nk,nkx->nx", shares, points[near]),
        gravity=np.asarray(scene.gravity_m_s2, dtype=float),
        ground=None if scene.ground is None else scene.ground.height_m - float(origin[2]),
        touches_itself=bool(declared.get("self_contact")),
        start_s=twin.release_s,
    )


def springs_between(points: Array, radius: float, most: int) -> Array:
    """Springs (S, 2): every point to its ``most`` nearest ones within ``radius`` [m]; each pair once, i < j."""
    count = min(most + 1, len(points))
    distance, other = cKDTree(points).query(points, k=count, distance_upper_bound=radius)
    rows = np.repeat(np.arange(len(points)), count).reshape(other.shape)
    near = np.isfinite(distance) & (other != rows)
    pairs = np.stack([rows[near], other[near]], axis=1)
    found: Array = np.unique(np.sort(pairs, axis=1), axis=0)
    return found


def _mass_points(twin: Twin) -> tuple[Array, Array, list[Array]]:
    """Points and velocities at the first frame, (P, 3), and the points that each grip holds."""
    body, lattice = twin.body, twin.lattice
    if lattice.dim > 1:
        rows = lattice.interpolation(lattice.particle_coordinates)
        groups: list[Array] = []
        for nodes in twin.held_nodes:
            on = np.zeros(len(body.start))
            on[nodes] = 1.0
            taken = np.concatenate([np.empty(0, dtype=int), *groups])
            groups.append(np.setdiff1d(np.flatnonzero(rows @ on > _HELD_SHARE), taken))
        return rows @ body.start, rows @ body.start_velocity, groups
    if not isinstance(lattice, Chain):
        raise SceneUnsupported("a rope without nodes along its axis")
    parent = np.asarray(lattice.parent)
    child = np.array(
        [np.argmax(parent == node) if before < 0 else node for node, before in enumerate(parent)]
    )
    along = body.start[child] - body.start[parent[child]]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    fixed = np.eye(3)[np.argmin(np.abs(along).max(axis=0))]
    first = np.cross(along, fixed)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(along, first)
    angles = 2.0 * np.pi * np.arange(AROUND) / AROUND
    ring = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    points = (body.start[:, None] + body.thickness_m * ring).reshape(-1, 3)
    velocity = np.repeat(body.start_velocity, AROUND, axis=0)
    return np.asarray(points), velocity, [_around(nodes) for nodes in twin.held_nodes]


def _around(nodes: Array) -> Array:
    numbers: Array = (AROUND * np.asarray(nodes, dtype=int)[:, None] + np.arange(AROUND)).ravel()
    return numbers


def _affine(points: Array, place: Array) -> Array:
    """Weights (k,) of least norm, of sum 1, that carry ``place`` along with any affine motion of ``points`` (k, 3)."""
    middle = points.mean(axis=0)
    rows = np.concatenate([np.ones((1, len(points))), (points - middle).T / max(np.ptp(points), 1e-12)])
    goal = np.concatenate([[1.0], (place - middle) / max(np.ptp(points), 1e-12)])
    weights: Array = np.linalg.pinv(rows, rcond=1e-6) @ goal
    weights /= weights.sum()
    return weights
