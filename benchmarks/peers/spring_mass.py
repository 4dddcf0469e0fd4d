"""A spring–mass simulator of PhysTwin's size: 5,000 points, 66,000 springs, 667 substeps a frame, no self-collision.

Written for the benchmarks, after the model of Jiang et al. 2025 (PhysTwin, section 3): points of equal mass, springs
with dashpots between neighbours, gravity, air drag, a ground with friction by impulses, semi-implicit Euler at 5e-5 s;
some points are held. Two Warp kernels a substep, one over springs that adds to both ends, one over points; the
substeps of a frame are one graph.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

POINTS, SPRINGS, SUBSTEPS = 5000, 66_000, 667
FRAME_S = 1.0 / 30.0
STIFFNESS_N, DASHPOT_N_S_M = 10.0, 0.02
POINT_KG, DRAG_PER_S = 1e-4, 0.5
FRICTION, RESTITUTION = 0.5, 0.1
GRAVITY_M_S2 = 9.81

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pull(
    # model
    ends: wp.array[wp.vec2i],
    rest: wp.array[wp.float32],
    # in
    x: wp.array[wp.vec3],
    v: wp.array[wp.vec3],
    # out
    force: wp.array[wp.vec3],
):
    """One spring with its dashpot, on both its ends."""
    s = wp.tid()
    i, j = ends[s][0], ends[s][1]
    along = x[j] - x[i]
    length = wp.length(along)
    unit = along / wp.max(length, 1.0e-9)
    size = STIFFNESS_N * (length / rest[s] - 1.0) + DASHPOT_N_S_M * wp.dot(v[j] - v[i], unit)
    wp.atomic_add(force, i, size * unit)
    wp.atomic_add(force, j, -size * unit)


@wp.kernel
def advance(
    # model
    held: wp.array[wp.int32],
    dt: wp.float32,
    # in and out
    force: wp.array[wp.vec3],
    x: wp.array[wp.vec3],
    v: wp.array[wp.vec3],
):
    """One point: forces, gravity, drag, ground z = 0, motion."""
    i = wp.tid()
    if held[i] == 0:
        here = x[i]
        gained = force[i] / POINT_KG - wp.vec3(0.0, 0.0, GRAVITY_M_S2)
        speed = (v[i] + dt * gained) * wp.exp(-dt * DRAG_PER_S)
        if here[2] + dt * speed[2] < 0.0 and speed[2] < 0.0:
            across = wp.vec3(speed[0], speed[1], 0.0)
            slip = wp.length(across)
            share = wp.max(
                0.0, 1.0 - FRICTION * (1.0 + RESTITUTION) * wp.abs(speed[2]) / wp.max(slip, 1.0e-9)
            )
            speed = share * across + wp.vec3(0.0, 0.0, -RESTITUTION * speed[2])
        v[i] = speed
        x[i] = here + dt * speed
    force[i] = wp.vec3(0.0, 0.0, 0.0)


class SpringMass:
    """A block of points in a jittered lattice, its lowest corner above the ground, one end held."""

    def __init__(self, seed: int, device: str = "cpu") -> None:
        rng = np.random.default_rng(seed)
        axes = [np.arange(count) for count in (40, 25, 5)]
        spacing = 0.01
        points = spacing * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        points += rng.uniform(-0.2, 0.2, points.shape) * spacing + np.array([0.0, 0.0, 0.3])
        pairs = _shortest_pairs(points, SPRINGS)
        lengths = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
        self.device, self.points, self.springs = device, len(points), len(pairs)
        self.dt_s = FRAME_S / SUBSTEPS
        on = {"device": device}
        self._ends = wp.array(pairs, dtype=wp.vec2i, **on)
        self._rest = wp.array(lengths, dtype=wp.float32, **on)
        self._held = wp.array((points[:, 0] < 0.02).astype(np.int32), dtype=wp.int32, **on)
        self._x = wp.array(points, dtype=wp.vec3, **on)
        self._v, self._force = (wp.zeros(len(points), dtype=wp.vec3, **on) for _ in range(2))
        wp.load_module(device=device)
        with wp.ScopedCapture(device=device) as capture:
            for _ in range(SUBSTEPS):
                self._substep()
        self._graph = capture.graph

    def frame(self) -> np.ndarray:
        """Positions after one more frame [m], (P, 3)."""
        wp.capture_launch(self._graph)
        return self._x.numpy()

    def _substep(self) -> None:
        device = self.device
        wp.launch(
            pull, self.springs, [self._ends, self._rest, self._x, self._v], [self._force], device=device
        )
        wp.launch(advance, self.points, [self._held, self.dt_s, self._force, self._x, self._v], device=device)


def _shortest_pairs(points: np.ndarray, count: int) -> np.ndarray:
    """The ``count`` shortest of all pairs of near points, (count, 2)."""
    pairs = cKDTree(points).query_pairs(0.03, output_type="ndarray")
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    return np.unique(pairs[np.argsort(length, kind="stable")[:count]], axis=0)
