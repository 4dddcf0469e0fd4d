"""What a demonstration may do: reach, speed, turn and spread of the grips, taken from the recording.

The recording's training frames tell how far and how fast its controllers went; a recording with still
controllers tells nothing, so every limit has a floor that is a fraction of the object's size. Grips never
move further apart than the material between them is long (its shortest path through the rest shape), so that
no motion tears the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from physworld.scene import Scene
from physworld.worldmodel.clock import model_dt, resample

if TYPE_CHECKING:
    from physworld.twin import Twin

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
IDENTITY_PRIOR = 1e-3  # keeps the rotation of a two-point grip minimal about its own axis


@dataclass(frozen=True)
class MotionLimits:
    """Limits of the grips' motion; G grips.

    Attributes:
        reach_min_m, reach_max_m: box of a grip centre's displacement from its first place, (3,).
        speed_m_s, acceleration_m_s2: of any control point.
        turn_rad: largest rotation of a grip from its first pose.
        spread_min_m, spread_max_m: distances between grip centres, (G, G).
        floor_m: lowest height of a control point, or -inf.
        size_m: largest side of the rest shape's bounding box.
    """

    reach_min_m: np.ndarray
    reach_max_m: np.ndarray
    speed_m_s: float
    acceleration_m_s2: float
    turn_rad: float
    spread_min_m: np.ndarray
    spread_max_m: np.ndarray
    floor_m: float
    size_m: float


def limits_of(scene: Scene, twin: Twin) -> MotionLimits:
    """The limits that the training frames of ``scene`` and the twin's rest shape give."""
    size = float(np.ptp(twin.particles_rest, axis=0).max())
    times, track = training_track(scene)
    groups = twin.controller_groups
    centres = np.stack([track[:, group].mean(axis=1) for group in groups], axis=1)
    moves = centres - centres[0]
    floor = _floor(scene, track, size)
    reach_min = np.minimum(moves.min(axis=(0, 1)), -REACH_FLOOR * size)
    reach_min[2] = max(reach_min[2], floor - float(track[0, :, 2].min()))
    distances = np.linalg.norm(centres[:, :, None] - centres[:, None, :], axis=-1)
    material = material_distances(twin.particles_rest, twin.particles_start, track[0], groups)
    speed, acceleration = _speed_and_acceleration(scene, times, track)
    speed = max(speed, SPEED_FLOOR * size)
    turns = [grip_turns(track[:, group]).magnitude() for group in groups if len(group) > 1]
    turn = float(np.percentile(np.concatenate(turns), SPEED_PERCENTILE)) if turns else 0.0
    return MotionLimits(
        reach_min_m=reach_min,
        reach_max_m=np.maximum(moves.max(axis=(0, 1)), REACH_FLOOR * size),
        speed_m_s=speed,
        acceleration_m_s2=max(acceleration, speed / RAMP_S),
        turn_rad=float(np.clip(turn, TURN_FLOOR_RAD, TURN_CEILING_RAD)),
        spread_min_m=np.minimum(CLOSENESS * distances[0], distances.min(axis=0) / SLACK),
        spread_max_m=np.maximum(SLACK * distances.max(axis=0), material),
        floor_m=floor,
        size_m=size,
    )


def training_track(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Control times (S,) [s] and points (S, K, 3) [m] of the training frames only, at the best rate."""
    start, end = scene.times[scene.train[0]], scene.times[scene.train[1] - 1]
    times, points = scene.control_track()
    inside = np.flatnonzero((times > start) & (times < end))
    all_times = np.concatenate([[start], times[inside], [end]])
    return all_times - start, resample(points, times, all_times)


def grip_turns(points: np.ndarray) -> Rotation:
    """Rotations of a rigid grip from its first pose, from its points (T, n, 3) by orthogonal Procrustes.

    A small pull towards the identity settles what too few points leave open: a grip of two points turns by
    the smallest rotation that carries one axis to the other.
    """
    first = points[0] - points[0].mean(axis=0)
    now = points - points.mean(axis=1, keepdims=True)
    prior = IDENTITY_PRIOR * max(float(np.sum(first**2)), np.finfo(np.float64).tiny)
    covariance = np.einsum("tni,nj->tij", now, first) + prior * np.eye(3)
    left, _, right = np.linalg.svd(covariance)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    return Rotation.from_matrix(left @ right)


def material_distances(
    rest: np.ndarray, start: np.ndarray, control_points: np.ndarray, groups: Sequence[np.ndarray]
) -> np.ndarray:
    """Shortest paths [m] through the rest shape between what the grips hold, (G, G); inf where none leads.

    Particles ``rest`` and ``start`` (P, 3) are the same material; each grip holds the particles of the start
    state that are nearest to its ``control_points`` (K, 3).
    """
    count = len(rest)
    distances, indices = cKDTree(rest).query(rest, k=min(GRAPH_NEIGHBORS, count - 1) + 1)
    rows = np.repeat(np.arange(count), indices.shape[1])
    entries = (distances.ravel(), (rows, indices.ravel()))
    graph = sparse.coo_matrix(entries, shape=(count, count)).tocsr()
    graph = graph.maximum(graph.T)
    _, nearest = cKDTree(start).query(control_points)
    held = [np.unique(nearest[group]) for group in groups]
    result = np.zeros((len(groups), len(groups)))
    for g, particles in enumerate(held):
        paths = csgraph.dijkstra(graph, directed=False, indices=particles)
        for h, others in enumerate(held):
            # between the middles of what the two hold, as the centres are
            result[g, h] = 0.0 if g == h else float(np.mean(paths[:, others]))
    return 0.5 * (result + result.T)


def _speed_and_acceleration(scene: Scene, times: np.ndarray, track: np.ndarray) -> tuple[float, float]:
    """High percentiles over the training track, differenced at the model's clock against tracking noise."""
    dt = model_dt(scene.fps)
    ticks = np.arange(0.0, times[-1] + 1e-9, dt)
    if len(ticks) < 3:
        return 0.0, 0.0
    velocity = np.diff(resample(track, times, ticks), axis=0) / dt
    speed = np.linalg.norm(velocity, axis=-1)
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=-1) / dt
    return float(np.percentile(speed, SPEED_PERCENTILE)), float(np.percentile(acceleration, SPEED_PERCENTILE))


def _floor(scene: Scene, track: np.ndarray, size: float) -> float:
    """Lowest height for a control point: just above the ground, or as low as the recording went."""
    if scene.ground is None:
        return -np.inf
    return min(scene.ground.height_m + GROUND_CLEARANCE * size, float(track[..., 2].min()))
