"""What a demonstration may do: reach, speed, turn and spread of the grips, taken from the recording.

The recording's training frames tell how far and how fast its controllers went; a recording with still
controllers tells nothing, so every limit has a floor that is a fraction of the object's size. Grips never
move further apart than the material between them is long (its shortest path through the rest shape), so that
no motion tears the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.geometry.rigid import rigid_motion
from physworld.scene import Scene
from physworld.worldmodel.clock import model_dt, resample

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

REACH_FLOOR = 0.25  # in object sizes: the smallest reach in every direction
SPEED_FLOOR = 1.5  # in object sizes per second
RAMP_S = 0.15  # time to reach the top speed from rest, at most
TURN_FLOOR_RAD = 0.35
TURN_CEILING_RAD = 1.2
SPEED_PERCENTILE = 99.0
GROUND_CLEARANCE = 0.02  # in object sizes
CLOSENESS = 0.3  # grips do not come nearer than this share of their first distance
SLACK = 1.01  # the recording's own noise must not forbid its first pose
GRAPH_NEIGHBORS = 24
JOINED_SHARE = 0.15  # grips with less material between them, in object sizes, are one body
CLAMP_SHARE = 0.5  # the same for grips that kept their distance within STEADY_SHARE
STEADY_SHARE = 0.1
STRETCH = {1: 0.03, 2: 0.05, 3: 0.1}
"""Largest extra strain of a stretch, by the body's dimension: ropes and sheets hardly give."""


@dataclass(frozen=True)
class MotionLimits:
    """Limits of the grips' motion; G grips.

    Attributes:
        grips: control points that move as one rigid body, G index arrays.
        reach_min_m, reach_max_m: box of a grip centre's displacement from its first place, (3,).
        speed_m_s, acceleration_m_s2: of any control point.
        turn_rad: largest rotation of a grip from its first pose.
        spread_min_m, spread_max_m: distances between grip centres, (G, G).
        floor_m: lowest height of a control point, or -inf.
        size_m: largest side of the rest shape's bounding box.
        pushers: control points that carry colliders and grip nothing, one index array a collider.
        object_centre_m: mean of the particles at the start, (3,).
        up: unit vector against gravity, (3,).
        stretch: how far a stretch may draw grips apart beyond ``spread_max_m``, as a share of it.
    """

    grips: tuple[Array, ...]
    reach_min_m: Array
    reach_max_m: Array
    speed_m_s: float
    acceleration_m_s2: float
    turn_rad: float
    spread_min_m: Array
    spread_max_m: Array
    floor_m: float
    size_m: float
    pushers: tuple[Array, ...] = ()
    object_centre_m: Array = field(default_factory=lambda: np.zeros(3))
    up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    stretch: float = 0.0

    @property
    def bodies(self) -> tuple[Array, ...]:
        """Everything that may move: grips, then pushers."""
        return (*self.grips, *self.pushers)


def limits_of(scene: Scene, twin: Twin) -> MotionLimits:
    """The limits that the training frames of ``scene`` and the twin's rest shape give."""
    rest, start = twin.particles_rest, twin.particles_start
    size = float(np.ptp(rest, axis=0).max())
    times, track = training_track(scene)
    paths = material_paths(rest, start, track[0])
    grips = _joined_grips(twin.controller_groups, track, paths, size)
    pushers = pushers_of(scene)
    moves = np.concatenate([_centres(track, (body,)) for body in (*grips, *pushers)], axis=1)
    moves = moves - moves[0]
    centres = _centres(track, grips)
    distances = np.linalg.norm(centres[:, :, None] - centres[:, None, :], axis=-1)
    floor = _floor(scene, track, size)
    reach_min = np.minimum(moves.min(axis=(0, 1)), -REACH_FLOOR * size)
    reach_min[2] = max(reach_min[2], floor - float(track[0, :, 2].min()))
    speed, acceleration = _speed_and_acceleration(scene, times, track)
    speed = max(speed, SPEED_FLOOR * size)
    return MotionLimits(
        grips=grips,
        reach_min_m=reach_min,
        reach_max_m=np.maximum(moves.max(axis=(0, 1)), REACH_FLOOR * size),
        speed_m_s=speed,
        acceleration_m_s2=max(acceleration, speed / RAMP_S),
        turn_rad=float(np.clip(_turn(grips, track), TURN_FLOOR_RAD, TURN_CEILING_RAD)),
        spread_min_m=np.minimum(CLOSENESS * distances[0], distances.min(axis=0) / SLACK),
        spread_max_m=np.maximum(SLACK * distances.max(axis=0), material_between(grips, paths)),
        floor_m=floor,
        size_m=size,
        pushers=pushers,
        object_centre_m=start.mean(axis=0),
        up=up_of(scene),
        stretch=STRETCH[twin.lattice.dim],
    )


def pushers_of(scene: Scene) -> tuple[Array, ...]:
    """Controllers that carry a collider, an index array for each such collider."""
    return tuple(
        np.array(collider.controllers, dtype=np.int64) for collider in scene.colliders if collider.controllers
    )


def up_of(scene: Scene) -> Array:
    """The unit vector against gravity, (3,); z where there is none."""
    strength = float(np.linalg.norm(scene.gravity_m_s2))
    return -scene.gravity_m_s2 / strength if strength > 0.0 else np.array([0.0, 0.0, 1.0])


def training_track(scene: Scene) -> tuple[Array, Array]:
    """Control times (S,) [s] and points (S, K, 3) [m] of the training frames only, at the best rate."""
    start, end = scene.times[scene.train[0]], scene.times[scene.train[1] - 1]
    times, points = scene.control_track()
    inside = np.flatnonzero((times > start) & (times < end))
    all_times = np.concatenate([[start], times[inside], [end]])
    return all_times - start, resample(points, times, all_times)


def material_paths(rest: Array, start: Array, control_points: Array) -> Array:
    """Shortest paths [m] through the rest shape between what the control points hold, (K, K); inf: none.

    Particles ``rest`` and ``start`` (P, 3) are the same material; each of the ``control_points`` (K, 3)
    holds the particle of the start state that is nearest to it.
    """
    parts = (np.ascontiguousarray(part, dtype=np.float64).tobytes() for part in (rest, start, control_points))
    return _material_paths(*parts)


@lru_cache(maxsize=4)
def _material_paths(rest_bytes: bytes, start_bytes: bytes, control_bytes: bytes) -> Array:
    """``material_paths`` of float64 points: the same for every episode of a twin, and most of its plan's cost."""
    rest, start, control_points = (
        np.frombuffer(part).reshape(-1, 3) for part in (rest_bytes, start_bytes, control_bytes)
    )
    count = len(rest)
    distances, indices = cKDTree(rest).query(rest, k=min(GRAPH_NEIGHBORS, count - 1) + 1)
    rows = np.repeat(np.arange(count), indices.shape[1])
    entries = (distances.ravel(), (rows, indices.ravel()))
    graph = sparse.coo_matrix(entries, shape=(count, count)).tocsr()
    _, nearest = cKDTree(start).query(control_points)
    paths: Array = csgraph.dijkstra(graph.maximum(graph.T), directed=False, indices=nearest)[:, nearest]
    return paths


def material_between(grips: Sequence[Array], paths: Array) -> Array:
    """Mean material path [m] between grips, (G, G), zero on the diagonal."""
    if not grips:
        return np.zeros((0, 0))
    means = np.array([[float(paths[np.ix_(one, other)].mean()) for other in grips] for one in grips])
    np.fill_diagonal(means, 0.0)  # a grip may hold two parts, with no path between them
    return means


def _joined_grips(groups: Sequence[Array], track: Array, paths: Array, size: float) -> tuple[Array, ...]:
    """Groups that move as one body: those on the same small piece of material.

    Groups are joined when the material between them is short, or shorter than half the object while the
    recording never moved them against each other (a clamp seen by several markers).
    """
    if not groups:
        return ()
    material = material_between(groups, paths)
    centres = _centres(track, groups)
    distances = np.linalg.norm(centres[:, :, None] - centres[:, None, :], axis=-1)
    steady = np.ptp(distances, axis=0) < STEADY_SHARE * distances[0]
    joined = (material < JOINED_SHARE * size) | (steady & (material < CLAMP_SHARE * size))
    count, labels = csgraph.connected_components(sparse.csr_matrix(joined), directed=False)
    return tuple(np.concatenate([groups[int(g)] for g in np.flatnonzero(labels == c)]) for c in range(count))


def _centres(track: Array, bodies: Sequence[Array]) -> Array:
    """Centres of bodies of control points (S, K, 3), (S, G, 3)."""
    return np.stack([track[:, body].mean(axis=1) for body in bodies], axis=1) if bodies else track[:, :0]


def _turn(grips: Sequence[Array], track: Array) -> float:
    """A high percentile of the grips' rotation from their first pose [rad]."""
    angles = [
        Rotation.from_matrix(rigid_motion(track[0, grip], track[:, grip])[0]).magnitude()
        for grip in grips
        if len(grip) > 1
    ]
    return float(np.percentile(np.concatenate(angles), SPEED_PERCENTILE)) if angles else 0.0


def _speed_and_acceleration(scene: Scene, times: Array, track: Array) -> tuple[float, float]:
    """High percentiles over the training track, differenced at the model's clock against tracking noise."""
    dt = model_dt(scene.fps)
    ticks = np.arange(0.0, times[-1] + 1e-9, dt)
    if len(ticks) < 3:
        return 0.0, 0.0
    velocity = np.diff(resample(track, times, ticks), axis=0) / dt
    speed = np.linalg.norm(velocity, axis=-1)
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=-1) / dt
    return float(np.percentile(speed, SPEED_PERCENTILE)), float(np.percentile(acceleration, SPEED_PERCENTILE))


def _floor(scene: Scene, track: Array, size: float) -> float:
    """Lowest height for a control point: just above the ground, or as low as the recording went."""
    if scene.ground is None:
        return -np.inf
    return min(scene.ground.height_m + GROUND_CLEARANCE * size, float(track[..., 2].min()))
