"""The recording's own control track as a demonstration, plain or varied. Training frames only.

- ``replay``           the track as it is, from the recording's own initial velocity
- ``replay_warped``    slower or faster, eased in from rest
- ``replay_mirrored``  reflected in the upright plane through the grips (or grip and object), eased in

The plane of the mirror holds the line between the first and the last grip, so that their spread stays what it
was; each grip stays rigid, its displacement reflected and its rotation R turned into M R M.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.demonstrate.motion import rigid_points
from physworld.geometry.rigid import rigid_motion
from physworld.worldmodel.clock import resample

VARIANTS = ("replay", "replay_warped", "replay_mirrored")
EASE_S = 0.2
ROUNDING_S = 1e-6  # a clock in single precision is so far off its ticks
WARP = (0.6, 1.5)


def playback_clock(times: Array, rate: float, ease_s: float = EASE_S) -> Array:
    """Track time at ``times`` (T,) [s]: the rate rises smoothly (3x² - 2x³) from 0 within ``ease_s``."""
    x = np.clip(times / ease_s, 0.0, 1.0)
    eased = ease_s * (x**3 - 0.5 * x**4)
    return rate * (eased + np.maximum(times - ease_s, 0.0))


def playback_duration(track_s: float, rate: float, ease_s: float = EASE_S) -> float:
    """How long [s] an eased playback of a track of ``track_s`` takes."""
    return track_s / rate + 0.5 * ease_s


def mirrored(track: Array, groups: Sequence[Array], object_centre: Array, up: Array) -> Array:
    """Control points (S, K, 3) reflected about their first pose, every group a rigid body.

    Args:
        object_centre: (3,), gives the plane where there is one grip only.
        up: unit vector in the plane of the mirror, (3,).
    """
    firsts = [track[0, group].mean(axis=0) for group in groups]
    along = firsts[-1] - firsts[0] if len(groups) > 1 else object_centre - firsts[0]
    across = np.cross(up, along)
    if np.linalg.norm(across) < 1e-6 * max(float(np.linalg.norm(along)), 1e-12):
        across = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    normal = across / np.linalg.norm(across)
    mirror = np.eye(3) - 2.0 * np.outer(normal, normal)
    result = np.repeat(track[:1], len(track), axis=0)
    for group, first in zip(groups, firsts, strict=True):
        displacement = (track[:, group].mean(axis=1) - first) @ mirror
        turns = np.zeros_like(displacement)
        if len(group) > 1:
            rotations, _ = rigid_motion(track[0, group], track[:, group])
            turns = Rotation.from_matrix(mirror @ rotations @ mirror).as_rotvec()
        result[:, group] = rigid_points(track[0, group], displacement, turns)
    return result


def replayed(track_times: Array, track: Array, times: Array) -> Array:
    """Control points (T, K, 3) of the track at its own ``times`` (T,) [s]; never past its end but by a rounding."""
    if times[-1] > track_times[-1] + ROUNDING_S:
        raise ValueError(f"replay up to {times[-1]:.4f} s of a track that ends at {track_times[-1]:.4f} s")
    return resample(track, track_times, times)
