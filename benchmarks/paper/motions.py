"""Five kinds of motion of a grip that neither the recordings nor the demonstrations have.

VMP-Gen moves grips there and back along Bézier curves. These go round, to and fro, fast and at once; all begin at rest
from the recording's first frame and last as long as it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.scene import Scene

REACH_M = 0.05
TURN_RAD = np.radians(40.0)
BEGIN_S = 0.25
"""In which a motion fades in."""

Way = Callable[[Array, Array], tuple[Array, Array]]
"""Times (T,) [s] and the unit vector from the grip to the body's middle to turns (T, 3) [rad] and shifts (T, 3) [m]."""


def _gain(times: Array) -> Array:
    gain: Array = (1.0 - np.exp(-((times / BEGIN_S) ** 2)))[:, None]
    return gain


def _circle(times: Array, axis: Array) -> tuple[Array, Array]:
    angle = 2.0 * np.pi * 1.0 * times
    way = np.stack([np.sin(angle), 1.0 - np.cos(angle), np.zeros_like(angle)], axis=1)
    return np.zeros((len(times), 3)), REACH_M * _gain(times) * way


def _eight(times: Array, axis: Array) -> tuple[Array, Array]:
    angle = 2.0 * np.pi * 0.8 * times
    way = np.stack([np.zeros_like(angle), np.sin(angle), np.sin(2.0 * angle)], axis=1)
    turns = np.stack([np.zeros_like(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    return 0.5 * TURN_RAD * _gain(times) * turns, REACH_M * _gain(times) * way


def _shake(times: Array, axis: Array) -> tuple[Array, Array]:
    way = np.sin(2.0 * np.pi * 3.0 * times)[:, None] * np.array([0.0, 1.0, 0.0])
    return np.zeros((len(times), 3)), 0.25 * REACH_M * _gain(times) * way


def _twist(times: Array, axis: Array) -> tuple[Array, Array]:
    turns = np.sin(2.0 * np.pi * 0.8 * times)[:, None] * axis
    return TURN_RAD * _gain(times) * turns, np.zeros((len(times), 3))


def _stop(times: Array, axis: Array) -> tuple[Array, Array]:
    share = np.clip((times - 0.2) / 0.3, 0.0, 1.0)
    smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    return np.zeros((len(times), 3)), 2.0 * REACH_M * smooth[:, None] * np.array([0.0, 0.6, 0.8])


WAYS: dict[str, Way] = {"circle": _circle, "eight": _eight, "shake": _shake, "twist": _twist, "stop": _stop}
"""Round at 1 Hz; a figure of eight that turns; to and fro at 3 Hz; about the body's own axis; 0.1 m in 0.3 s, then
still."""


def motions(scene: Scene) -> dict[str, Scene]:
    """The scene's first frame under every kind of motion; points and times after the first frame mean nothing."""
    rest = scene.controllers[0]
    centre = rest.mean(axis=0)
    axis = scene.points[0].mean(axis=0) - centre
    axis = axis / np.linalg.norm(axis)
    found = {}
    for name, way in WAYS.items():
        turns, shifts = way(scene.times - scene.times[0], axis)
        turned = np.einsum("tij,kj->tki", Rotation.from_rotvec(turns).as_matrix(), rest - centre)
        found[name] = replace(
            scene,
            name=f"{scene.name} {name}",
            points=np.repeat(scene.points[:1], len(scene.points), axis=0),
            controllers=turned + centre + shifts[:, None],
            controller_velocities=None,
        )
    return found
