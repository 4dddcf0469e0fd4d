"""How uncertain the pose of a body at its start is, where noisy points of frame 0 gave it.

A rope or a sheet that is declared undeformed lies along the line or in the plane of its first points. Their noise
turns it as a whole: a rope of nine markers by about sigma / (2 L), and then it swings as under a tilted gravity. Turns
about the body's axes through its grips are taken out of every residual by their covariance
(:meth:`physworld.trace.whitening.Whitener.knowing`). Bodies from facts without noise (``rest_volume_points``, a box)
have none; of starts that are fitted to several frames it is not known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.scene import AS_MEASURED, Scene
from physworld.twin.twin import Twin

_LEAST_LEVER = 0.05  # of the body's size: points nearer to an axis than this say nothing of a turn about it


def turned_starts(scene: Scene, twin: Twin, sigma: float) -> list[Twin]:
    """The twin with its start turned by one standard deviation about every axis that noise leaves uncertain."""
    if twin.lattice.dim == 3 or scene.initial_state == AS_MEASURED or scene.rest_volume_points is not None:
        return []
    start = twin.body.start
    held = np.concatenate([nodes for nodes in twin.held_nodes if len(nodes)] or [np.arange(len(start))])
    centre = start[held].mean(axis=0)
    points = scene.points[0][scene.visible[0]]
    levers = points - points.mean(axis=0)
    axes = np.linalg.svd(start - start.mean(axis=0), full_matrices=False)[2]
    size = float(np.ptp(start, axis=0).max())
    found = []
    for axis in axes:
        arms = np.linalg.norm(np.cross(axis, levers), axis=1)
        lever = float(np.sqrt(np.sum(arms**2)))
        if lever < _LEAST_LEVER * size * np.sqrt(len(points)):
            continue
        turn = Rotation.from_rotvec(axis * sigma / lever)
        turned = replace(twin.body, start=centre + turn.apply(start - centre))
        if twin.lattice.dim == 1:  # the points stay where they were seen
            moved_by = twin.lattice.interpolation(twin.body.points) @ (turned.start - start)
            turned = replace(turned, offsets=twin.body.offsets - moved_by)
        found.append(replace(twin, body=turned))
    return found
