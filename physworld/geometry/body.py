"""What a reference body is, where its tracked points are at the first frame, and where its nodes carry them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.geometry.rigid import least_rotation
from physworld.scene import Scene

_NEIGHBOURS = 6  # points that tell where another one was before it was seen


@dataclass(frozen=True)
class ReferenceBody:
    """A lattice, its nodes in the world without stress and at the start, and the tracked points inside it.

    Attributes:
        lattice: cells, nodes, particles.
        rest: nodal positions without stress [m], (n, 3).
        start, start_velocity: nodal positions [m] and velocities [m/s] at the first frame, (n, 3).
        points: material coordinates of the tracked points [m], (N, d).
        offsets: distance of a tracked point from the sheet [m], (N, 1), or from the rod at the start [m], (N, 3);
            zero columns for a solid.
        thickness_m: thickness of a sheet or radius of a rod, declared or assumed.
        notes: what was assumed, in words.
        added_mass: declared loads as lumped nodal masses [kg], (n,), or None.
        settles: a discrete rod starts as it hangs still under its grips, near ``start``.
    """

    lattice: Lattice
    rest: Array
    start: Array
    start_velocity: Array
    points: Array
    offsets: Array
    thickness_m: float
    notes: tuple[str, ...] = ()
    added_mass: Array | None = None
    settles: bool = False

    @property
    def half_thickness_m(self) -> float:
        """Distance of the surface from a sheet's middle or a rod's axis [m]; 0 for a solid."""
        return {3: 0.0, 2: 0.5, 1: 1.0}[self.lattice.dim] * self.thickness_m


def first_points(scene: Scene) -> Array:
    """Tracked points at the first frame, (N, 3) [m].

    A point that was not seen then is where its first sight was, less what its neighbours have moved until then.
    Held-out frames are not looked at; a point that was never seen takes another's place.
    """
    end = scene.train[1] or scene.frame_count
    visible = scene.visible[:end] if scene.visible[:end].any() else scene.visible
    points: Array = scene.points[0].astype(float)
    for n in np.flatnonzero(~visible[0] & visible.any(axis=0)):
        first = int(np.argmax(visible[:, n]))
        points[n] = scene.points[first, n]
        known = np.flatnonzero(visible[0] & visible[first])
        gap = np.linalg.norm(scene.points[first, known] - points[n], axis=1)
        near = known[np.argsort(gap)[:_NEIGHBOURS]]
        if len(near):
            points[n] -= (scene.points[first, near] - scene.points[0, near]).mean(axis=0)
    sighted = visible.any(axis=0)
    points[~sighted] = points[np.argmax(sighted)]
    return points


def material_tracks(body: ReferenceBody, nodes: Array) -> Array:
    """Tracked points (T, N, 3) of the nodes' trajectories (T, n, 3) [m].

    Points beside a sheet's middle surface move along its normal, those beside a rope's centre line with its section.
    """
    lattice = body.lattice
    tracks = applied(lattice.interpolation(body.points), nodes)
    if lattice.dim == 2 and np.any(body.offsets):
        first = applied(lattice.interpolation(body.points, (1, 0)), nodes)
        second = applied(lattice.interpolation(body.points, (0, 1)), nodes)
        normal = np.cross(first, second)
        tracks = tracks + body.offsets * normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    elif lattice.dim == 1 and np.any(body.offsets):
        slope = lattice.interpolation(body.points, (1,))
        turn = least_rotation((slope @ body.start)[None], applied(slope, nodes))
        tracks = tracks + np.einsum("tnij,nj->tni", turn, body.offsets)
    return tracks


def applied(matrix: Any, nodes: Array) -> Array:
    """Sparse (M, n) times trajectories (T, n, 3): (T, M, 3)."""
    frames, n, _ = nodes.shape
    flat = matrix @ nodes.transpose(1, 0, 2).reshape(n, -1)
    return np.asarray(flat).reshape(matrix.shape[0], frames, 3).transpose(1, 0, 2)
