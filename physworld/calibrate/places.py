"""Where tracked points lie in a body that was measured as it was: by all training frames, not by the first alone.

A point's place in the material comes from the first frame. Where the scene starts undeformed that is as good as the
tracking (:meth:`physworld.calibrate.search.Search.shift_points`). Where it starts as measured, the body between its
points has a shape that is interpolated: bent by a load, or propped by a hand that nobody declares, it errs by more
than the tracking.

With the fitted motion kept, each point's shift is the ridge solution of its residuals. Frames near each other err
alike, so a block of frames counts once. All frames count alike: those that err least are the first ones, which the
places of the first frame fit by construction. Nothing but training frames enters.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.estimation.whitening import moved, responses
from physworld.scene import UNDEFORMED_AT_REST, Scene
from physworld.twin.twin import Twin

PLACE_SHARE = 0.01
"""Standard deviation of a place, of the extent of points and grips in the first frame."""
_BLOCKS, _LEAST_M = 12, 1e-7


def placed_as_seen(scene: Scene, twin: Twin, nodes: Array) -> Twin:
    """The twin with its tracked points where the training frames say that they lie: see :func:`misplaced_by`."""
    shifts = misplaced_by(scene, twin, nodes)
    return twin if shifts is None else moved(twin, shifts)


def misplaced_by(scene: Scene, twin: Twin, nodes: Array) -> Array | None:
    """From where the first frame shows tracked points to where they lie in the body [m], (N, 3).

    Args:
        scene: the recording; of one that starts undeformed nothing is said.
        twin: calibrated.
        nodes: its carriers, of the training frames at least, (T, n, 3) [m].
    """
    if scene.initial_state == UNDEFORMED_AT_REST or twin.form.on_particles:
        return None
    frames = slice(*scene.train)
    seen = scene.visible[frames]
    tracks = twin.observe(nodes, scene.times[: len(nodes)])[frames]
    error = np.where(seen[..., None], scene.points[frames] - tracks, 0.0)
    first = np.concatenate([scene.points[0][scene.visible[0]], scene.controllers[0]])
    if not len(first) or not np.isfinite(error).all():
        return None
    deviation = PLACE_SHARE * float(np.linalg.norm(np.ptp(first, axis=0))) + _LEAST_M
    response = responses(twin, nodes)[frames]
    square = float((error**2).sum()) / max(3 * int(seen.sum()), 1) + _LEAST_M**2
    weight = min(_BLOCKS, len(error)) / len(error) / square
    told = weight * np.einsum("tnij,tnik->njk", response, response * seen[..., None, None])
    along = weight * np.einsum("tnij,tni->nj", response, error)
    shifts: Array = np.linalg.solve(told + np.eye(3) / deviation**2, along[..., None])[..., 0]
    return shifts
