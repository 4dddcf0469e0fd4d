"""A linear time-invariant cloth: a grid of springs and dampers whose held nodes are inputs.

After the control model of Luque, Parent, Colomé, Ocampo-Martinez and Torras (Model Predictive Control for Dynamic Cloth
Manipulation): equal masses on a grid, each bound to its neighbours by springs and dampers that act along every axis for
itself, so displacements u from the first frame, taken as equilibrium under gravity, follow per axis

    u'' = -k Λ u - b Λ u' - d u',     Λ the grid's Laplacian, u of held nodes given.

k [1/s²] and b [1/s] differ for the horizontal axis along the line between the grips, the one across it, and the
vertical; d [1/s] is a drag beside the publication's model. In the modes of Λ the equations part; time goes
by the trapezoidal rule. Being linear, it knows no turn of the cloth and no inextensibility.

Fitted to the training frames: the seven numbers, by logarithm; k and b are kept per (n - 1)², so that another grid over
the same cloth takes them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from physworld.arrays import Array
from physworld.baselines.fitting import least_squares
from physworld.errors import SceneUnsupported
from physworld.evaluate.baselines import start_positions
from physworld.scene import Scene

STEP_S = 0.02
# logarithms: k along, across, vertical [1/s²]; b likewise [1/s]; d [1/s]
LOWER = np.log([1e-2] * 3 + [1e-5] * 3 + [1e-3])
UPPER = np.log([1e4] * 3 + [1e2] * 3 + [2e1])
STARTS = np.log([[k] * 3 + [0.03 * k] * 3 + [0.5] for k in (1.0, 5.0, 30.0)])


def fit_linear_cloth(scene: Scene) -> Callable[[Scene], Array]:
    """The cloth fitted to the training frames of ``scene``; what is returned predicts any recording of that cloth.

    Raises:
        SceneUnsupported: no grid is declared, or nothing holds it.
    """
    held_nodes(scene)
    first, last = scene.train
    if first > 0:
        raise SceneUnsupported(f"training frames begin at {first}; the cloth starts at frame 0")
    seen = scene.visible[1:last]

    def residuals(theta: Array) -> Array:
        tracks = simulate(scene, theta, last)[:, 1:]
        error = np.where(seen[None, ..., None], tracks - scene.points[None, 1:last], 0.0)
        return error.reshape(len(theta), -1)

    theta = least_squares(residuals, STARTS, LOWER, UPPER)
    return lambda other: simulate(other, theta[None], other.frame_count)[0]


def simulate(scene: Scene, theta: Array, frames: int) -> Array:
    """Tracked points (B, frames, N, 3) [m] of candidates (B, 7), as ``LOWER`` lists them."""
    rows, columns = _grid(scene)
    held, which = held_nodes(scene)
    start = start_positions(scene)
    free = np.setdiff1d(np.arange(len(start)), held)
    laplacian = grid_laplacian(rows, columns) * ((rows - 1) * (columns - 1))
    modes, shapes = np.linalg.eigh(laplacian[np.ix_(free, free)])
    reach = shapes.T @ laplacian[np.ix_(free, held)]
    axes = _axes(start[held])
    clock, controls = scene.control_track()
    steps = np.maximum(1, np.ceil(np.diff(scene.times[:frames]) / STEP_S - 1e-9).astype(int))
    times = np.concatenate(
        [
            scene.times[:1],
            *(np.linspace(scene.times[t], scene.times[t + 1], n + 1)[1:] for t, n in enumerate(steps)),
        ]
    )
    moved = controls[:, which] - scene.controllers[0, which]
    inputs = np.stack(
        [
            np.stack([np.interp(times, clock, moved[:, k, a]) for a in range(3)], axis=1)
            for k in range(len(held))
        ],
        1,
    )
    pull = np.einsum("fk,tka->tfa", reach, inputs @ axes)
    numbers = np.exp(theta)
    stiff, damp = (
        modes[:, None] * numbers[:, None, :3],
        modes[:, None] * numbers[:, None, 3:6] + numbers[:, 6:, None],
    )
    q = np.zeros((len(theta), len(free), 3))
    rate = np.zeros_like(q)
    kept = np.empty((len(theta), frames, len(free), 3))
    kept[:, 0] = q
    ends = np.concatenate([[0], np.cumsum(steps)])
    for frame in range(1, frames):
        for step in range(ends[frame - 1], ends[frame]):
            dt = times[step + 1] - times[step]
            middle = 0.5 * (pull[step] + pull[step + 1])
            speed = (pull[step + 1] - pull[step]) / dt
            force = -numbers[:, None, :3] * middle - numbers[:, None, 3:6] * speed
            change = dt * (force - stiff * (q + 0.5 * dt * rate) - damp * rate)
            change /= 1.0 + 0.5 * dt * damp + 0.25 * dt**2 * stiff
            q = q + dt * (rate + 0.5 * change)
            rate = rate + change
        kept[:, frame] = q
    tracks = np.broadcast_to(start, (len(theta), frames, *start.shape)).copy()
    tracks[:, :, free] += (shapes @ kept) @ axes.T
    tracks[:, :, held] += inputs[ends[:frames]]
    return tracks


def held_nodes(scene: Scene) -> tuple[Array, Array]:
    """The node nearest to every controller at the first frame, and that controller. Raises SceneUnsupported."""
    _grid(scene)
    if not scene.controllers.shape[1]:
        raise SceneUnsupported("nothing holds it")
    apart = np.linalg.norm(start_positions(scene)[:, None] - scene.controllers[0], axis=-1)
    nodes, first = np.unique(apart.argmin(axis=0), return_index=True)
    return nodes, first


def grid_laplacian(rows: int, columns: int) -> Array:
    """Λ of a grid whose nodes are bound to their neighbours along rows and columns, (rows columns)²."""

    def path(count: int) -> Array:
        steps = np.eye(count - 1, count, 1) - np.eye(count - 1, count)
        matrix: Array = steps.T @ steps
        return matrix

    laplacian: Array = np.kron(path(rows), np.eye(columns)) + np.kron(np.eye(rows), path(columns))
    return laplacian


def _grid(scene: Scene) -> tuple[int, int]:
    shape = scene.body.grid_shape
    if shape is None or shape[0] * shape[1] != scene.points.shape[1]:
        raise SceneUnsupported(f"a {scene.kind} of {scene.points.shape[1]} points on no declared grid")
    return shape


def _axes(held: Array) -> Array:
    """Columns: the horizontal direction between the first and the last held node, that across it, the vertical."""
    line = (held[-1] - held[0]) * [1.0, 1.0, 0.0]
    size = float(np.linalg.norm(line))
    along = line / size if size > 0 else np.array([1.0, 0.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([along, np.cross(up, along), up], axis=1)
