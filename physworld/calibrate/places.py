"""Where tracked points lie in a body that was measured as it was: by all training frames, not by the first alone.

A point's place in the material comes from the first frame. Where the scene starts undeformed that is as good as the
tracking (:meth:`physworld.calibrate.search.Search.shift_points`). Where it starts as measured, the body between its
points has a shape that is interpolated: bent by a load, or propped by a hand that nobody declares. A marker that stands
off the body then lies elsewhere in it by its lever times the error of the slope, far more than the tracking errs: of
six markers on a cast beam, fitted to their design places, a millimetre is left.

With the fitted motion kept, each point's shift is the ridge solution of its residuals. Frames near each other err
alike, so a block of frames counts once, by the inverse of its own mean square: where the model errs little its mean
tells most. Nothing but training frames enters.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.estimation.whitening import moved, responses
from physworld.scene import UNDEFORMED_AT_REST, Scene
from physworld.twin.twin import Twin

PLACE_SHARE = 0.01
"""Standard deviation of a place, of the extent of the points and grips in the first frame."""
_BLOCKS, _ROUNDS, _LEAST_M = 12, 4, 1e-7


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
    extent = float(np.linalg.norm(np.ptp(first, axis=0))) if len(first) else 0.0
    if extent == 0.0 or not np.isfinite(error).all():
        return None
    least = max(scene.noise_sigma_m or 0.0, _LEAST_M)
    return _shifts(error, seen, responses(twin, nodes)[frames], PLACE_SHARE * extent, least)


def _shifts(error: Array, seen: Array, response: Array, prior: float, least: float) -> Array:
    """Shifts of places (N, 3) [m].

    Args:
        error: measured minus predicted [m], (T, N, 3), 0 where nothing was seen.
        seen: (T, N) bool.
        response: of every track to its point's place, (T, N, 3, 3).
        prior: standard deviation of a place [m].
        least: by which a block errs at least [m].
    """
    block = np.arange(len(error)) * min(_BLOCKS, len(error)) // len(error)
    normal = np.einsum("tnij,tnik->tnjk", response, response * seen[..., None, None])
    along = np.einsum("tnij,tni->tnj", response, error)
    shift = np.zeros(error.shape[1:])
    for _ in range(_ROUNDS):
        left = np.where(seen[..., None], error - np.einsum("tnij,nj->tni", response, shift), 0.0)
        square = np.bincount(block, (left**2).sum(axis=(1, 2)))
        counts = np.maximum(np.bincount(block, 3.0 * seen.sum(axis=1)), 1.0)
        weight = (1.0 / np.maximum(square / counts, least**2) / np.bincount(block))[block]
        told = np.einsum("t,tnjk->njk", weight, normal) + np.eye(3) / prior**2
        shift = np.linalg.solve(told, np.einsum("t,tnj->nj", weight, along)[..., None])[..., 0]
    return shift
