"""A pseudo-rigid-body chain: rigid links with springs and dampers in their joints, held at one end.

The mechanical model behind PRB-Net (Mamedov, Geist, Swevers, Trimpe 2024, arXiv:2307.07975), whose learned dynamics
and encoder are not here: the hidden shape at the first frame is the one at rest under the fitted stiffness, so a
recording that begins in motion is not met. The first link is held by the grip, which carries full pose where its
controllers do not lie on a line.

Fitted to the training frames: bending, joint damping and drag, by logarithm; two angles [rad] between the grip and the
link that it holds; where along the chain the tracked points between its ends sit [share of the length].
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from physworld.arrays import Array
from physworld.baselines.chain import Chain, Coefficients
from physworld.baselines.fitting import least_squares
from physworld.errors import SceneUnsupported
from physworld.evaluate.baselines import start_positions
from physworld.geometry.rigid import rigid_groups, rigid_motion
from physworld.scene import Scene

KINDS = ("rod", "foam_rod")
LINKS = 8
EARLY = 0.25  # of the training frames
SETTLE_DRAG, SETTLE_TIME = 4.0, 8.0
"""Drag and time of the settling to rest, in units of the rate √(g/L) of a hanging rod of that length."""
_SHIFT = 0.1  # most share of the length by which a tracked point may sit elsewhere than its chord says


def fit_rigid_links(scene: Scene) -> Callable[[Scene], Array]:
    """The chain fitted to the training frames of ``scene``; what is returned predicts any recording of that rod.

    Raises:
        SceneUnsupported: it is no rod, not held at one end alone, or its length is not declared.
    """
    refuse(scene)
    first, last = scene.train
    if first > 0:
        raise SceneUnsupported(f"training frames begin at {first}; the chain starts at frame 0")
    seen = scene.visible[1:last]
    between = scene.points.shape[1] - 2
    # of a bar of that length that hangs under its weight: bending that sags a tenth to all of it
    size = float(np.linalg.norm(scene.gravity_m_s2)) * _length(scene) ** 3
    lower = np.concatenate(
        [np.log([1e-3 * size, 1e-6 * size, 1e-3]), [-1.5, -1.5], np.full(between, -_SHIFT)]
    )
    upper = np.concatenate([np.log([1e1 * size, 1e0 * size, 1e1]), [1.5, 1.5], np.full(between, _SHIFT)])
    starts = np.stack(
        [
            np.concatenate([np.log([b * size, 0.05 * b * size, 0.2]), np.zeros(2 + between)])
            for b in (0.02, 0.1, 0.4)
        ]
    )

    def residuals(end: int, theta: Array) -> Array:
        tracks = simulate(scene, theta, end)[:, 1:]
        error = np.where(seen[None, : end - 1, :, None], tracks - scene.points[None, 1:end], 0.0)
        return error.reshape(len(theta), -1)

    # over all frames at once a descent ends in the nearest of many minima: first an early window, from every start
    early = partial(residuals, max(4, round(EARLY * last)))
    found = [least_squares(early, start[None], lower, upper) for start in starts]
    theta = least_squares(partial(residuals, last), np.stack(found), lower, upper)
    return lambda other: simulate(other, theta[None], other.frame_count)[0]


def simulate(scene: Scene, theta: Array, frames: int) -> Array:
    """Tracked points (B, frames, N, 3) [m] of candidates (B, 5 + N - 2)."""
    refuse(scene)
    points = start_positions(scene)
    length, link = _length(scene), _length(scene) / LINKS
    chain = Chain(np.full(LINKS + 1, link), np.arange(LINKS + 2) < 2, lumped=False)
    rotations, shifts = rigid_motion(scene.controllers[0], scene.controllers[:frames])
    base = rotations @ points[0] + shifts
    directions = _turned((points[1] - points[0]) / np.linalg.norm(points[1] - points[0]), theta[:, 3:5])
    behind = base - link * np.einsum("tij,bj->bti", rotations, directions)
    driven = np.stack([behind, np.broadcast_to(base, behind.shape)], axis=2)
    chords = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    arc = np.linspace(0.0, chords[-1], LINKS + 1)
    along = np.stack([np.interp(arc, chords, points[:, axis]) for axis in range(3)], axis=1)
    start = np.concatenate([driven[:, 0, :1], np.broadcast_to(along, (len(theta), *along.shape))], axis=1)
    bending, damping, drag = np.exp(theta[:, :3]).T
    none = np.zeros(len(theta))
    gravity = scene.gravity_m_s2
    rate = np.sqrt(max(float(np.linalg.norm(gravity)), 1e-3) / length)
    still = Coefficients(bending, damping, drag + SETTLE_DRAG * rate, none)
    held = np.repeat(driven[:, :1], 2, axis=1)
    with np.errstate(all="ignore"):
        times = np.array([0.0, SETTLE_TIME / rate])
        start = chain.run(start, np.zeros_like(start), held, times, gravity, still)[:, -1]
        of = Coefficients(bending, damping, drag, none)
        nodes = chain.run(start, np.zeros_like(start), driven, scene.times[:frames], gravity, of)
    share = np.broadcast_to(chords / chords[-1], (len(theta), len(chords))).copy()
    share[:, 1:-1] += theta[:, 5:]
    place = np.clip(share * length / link, 0.0, LINKS - 1e-9)
    index = place.astype(int)
    part = (place - index)[:, None, :, None]
    rows = np.arange(len(theta))[:, None]
    before = nodes.transpose(0, 2, 1, 3)[rows, index + 1].transpose(0, 2, 1, 3)
    after = nodes.transpose(0, 2, 1, 3)[rows, index + 2].transpose(0, 2, 1, 3)
    tracks: Array = (1.0 - part) * before + part * after
    return tracks


def refuse(scene: Scene) -> None:
    """Raises SceneUnsupported where the chain has no word for the object."""
    if scene.kind not in KINDS:
        raise SceneUnsupported(f"a {scene.kind} is no rod ({', '.join(KINDS)})")
    if scene.points.shape[1] < 2:
        raise SceneUnsupported("one tracked point shows no direction")
    groups = rigid_groups(scene.controllers, _length(scene))
    if len(groups) != 1:
        raise SceneUnsupported(f"{len(groups)} grips; the chain is held at its first end alone")


def _length(scene: Scene) -> float:
    if scene.body.length_m is None:
        raise SceneUnsupported("its length is not declared")
    return scene.body.length_m


def _turned(direction: Array, angles: Array) -> Array:
    """The unit vector (3,) turned by two angles (B, 2) [rad] about the axes across it: (B, 3)."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    second = np.cross(direction, first)
    a, b = angles[:, :1], angles[:, 1:]
    turned: Array = np.cos(b) * (np.cos(a) * direction + np.sin(a) * first) + np.sin(b) * second
    return turned
