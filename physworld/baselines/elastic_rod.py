"""A discrete elastic rod after DEFORM's form (Chen et al. 2024, arXiv:2406.05931), without its learned residual.

What it shares with DEFORM: nodes are the tracked points, links do not stretch, twist is quasi-static, both grips hold
a link, stiffness and damping are fitted to recorded motion in open loop. What it lacks: the graph network that corrects
every step (its weights are the authors'; without them there is no residual here), a stiffness and a mass of every
node, and a natural curvature. Of a rope alone: the points follow each other along it.

Fitted: bending, twist, joint damping and drag, by logarithm, to the training frames; masses do not show, since no force
is measured.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from physworld.arrays import Array
from physworld.baselines.chain import Chain, Coefficients
from physworld.baselines.fitting import least_squares
from physworld.errors import SceneUnsupported
from physworld.evaluate.baselines import constant_velocity, start_positions
from physworld.scene import Scene

KINDS = ("rope", "rod", "cable")
LEAST_POINTS = 5
NEAR_M = 5e-3  # a controller this near a point at the first frame drives it
# logarithms of bending [m⁴/s²], joint damping [m⁴/s], drag [1/s], twist [m⁴/s²]
LOWER = np.log([1e-4, 1e-7, 1e-3, 1e-5])
UPPER = np.log([1e1, 1e0, 2e1, 1e1])
STARTS = np.log([[b, 2e-2 * b, 0.3, 0.5 * b] for b in (3e-3, 2e-2, 1e-1, 5e-1)])


def fit_elastic_rod(scene: Scene) -> Callable[[Scene], Array]:
    """The rod fitted to the training frames of ``scene``; what is returned predicts any recording of that rope.

    Raises:
        SceneUnsupported: it is no rope, its points do not show its shape, or no controller holds a point.
    """
    rod_of(scene)
    first, last = scene.train
    if first > 0:
        raise SceneUnsupported(f"training frames begin at {first}; the rod starts at frame 0")
    window = slice(1, last)
    seen = scene.visible[window]

    def residuals(theta: Array) -> Array:
        tracks = simulate(scene, theta, last)[:, 1:]
        error = np.where(seen[None, ..., None], tracks - scene.points[None, window], 0.0)
        return error.reshape(len(theta), -1)

    theta = least_squares(residuals, STARTS, LOWER, UPPER)
    return lambda other: simulate(other, theta[None], other.frame_count)[0]


def simulate(scene: Scene, theta: Array, frames: int) -> Array:
    """Tracked points (B, frames, N, 3) [m] of candidates (B, 4), as ``LOWER`` lists them."""
    chain, which = rod_of(scene)
    start = start_positions(scene)
    driven = np.flatnonzero(chain.driven)
    offset = start[driven] - scene.controllers[0, which]
    paths = scene.controllers[:frames, which] + offset
    lead = constant_velocity(scene)[1] - start
    velocity = lead / (scene.times[1] - scene.times[0])
    bending, damping, drag, twist = np.exp(theta).T
    of = Coefficients(bending, damping, drag, twist)
    with np.errstate(all="ignore"):
        return chain.run(start, velocity, paths, scene.times[:frames], scene.gravity_m_s2, of)


def rod_of(scene: Scene) -> tuple[Chain, Array]:
    """The chain of a scene, and of every driven node the controller that drives it. Raises SceneUnsupported."""
    count = scene.points.shape[1]
    if scene.kind not in KINDS:
        raise SceneUnsupported(f"a {scene.kind} is no rope ({', '.join(KINDS)})")
    if count < LEAST_POINTS:
        raise SceneUnsupported(f"{count} tracked points do not show a rope's shape; {LEAST_POINTS} would")
    edges = scene.body.edges
    if edges is not None and not np.array_equal(np.sort(edges, 1), [[i, i + 1] for i in range(count - 1)]):
        raise SceneUnsupported("its points do not follow each other along one rope")
    start = start_positions(scene)
    if not scene.controllers.shape[1]:
        raise SceneUnsupported("nothing holds it")
    distance = np.linalg.norm(start[:, None] - scene.controllers[0], axis=-1)
    nearest = distance.argmin(axis=1)
    driven = distance.min(axis=1) < NEAR_M
    if not driven.any():
        raise SceneUnsupported(f"no controller is within {NEAR_M} m of a point at the first frame")
    lengths = np.linalg.norm(np.diff(start, axis=0), axis=1)
    return Chain(lengths, driven, lumped=True), nearest[driven]
