"""What holds the object in a folder of pictures: its motion from whatever tells it, and the scene's controllers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.grips import LogFrame, colour_middles, logged, translated
from physworld.tracking.poses import marker_path
from physworld.tracking.recording import Followed, patch_points
from physworld.tracking.rigid import RigidPath, rigid_path
from physworld.tracking.view import Box, View, cloud_of
from physworld_scenes.errors import refused
from physworld_scenes.importers.robot.log import read_log

GRIP_MARGIN_M = 0.01
REACH_SHARE = 0.1
"""Of the object's size, beyond the nearest point: what a gripper holds where nobody says."""
LEAST_HELD_PX = 4


@dataclass(frozen=True)
class GripFrom:
    """What tells the gripper's motion; one of the first four.

    Attributes:
        marker: number of an ArUco or AprilTag marker on it; -1: the first that is seen.
        dictionary: of the marker.
        patch: a box on it in the first camera's first picture: its texture is followed.
        colour: column and row of a pixel of its colour there; such a gripper does not turn.
        log: of a robot, SI units: CSV with a head (t, x, y, z and, if it turns, qw, qx, qy, qz), MCAP, or a file or
            folder of LeRobot.
        log_pose, log_episode: which pose and episode of it, where it has several.
        log_delay_s: of the pictures' clock behind the log's.
        log_base: pose of the log's frame (the robot's base) in the cameras' world, as a hand-eye calibration gives it:
            x, y, z [m] and a quaternion, scalar first; None: the log is in the scene's world.
        held_px: a box around what it holds of the object, in the same picture.
        held_m: instead, the corners of a box of undeformed material [m], (2, 3), in the scene's world.
    """

    marker: int | None = None
    dictionary: str = "4X4_50"
    patch: Box | None = None
    colour: tuple[int, int] | None = None
    log: Path | None = None
    log_pose: str | None = None
    log_episode: int | None = None
    log_delay_s: float = 0.0
    log_base: tuple[float, ...] | None = None
    held_px: Box | None = None
    held_m: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None


def gripper_path(
    views: list[View],
    grip: GripFrom,
    times: Array,
    warnings: list[str],
    turned: Array | None = None,
) -> RigidPath:
    """The gripper's motion from what tells it, seen by all cameras.

    Args:
        views: the cameras.
        grip: what tells it.
        times: of the frames [s], (T,).
        warnings: what a log does not say is added.
        turned: the cameras' world in the scene's, 4 × 4; None: they are one.

    Raises:
        TrackingFailed: it is not seen, or the log does not cover the recording.
        SceneInvalid: the log is no log.
    """
    if grip.marker is not None:
        number = None if grip.marker < 0 else grip.marker
        return marker_path(views, number, grip.dictionary)
    if grip.patch is not None:
        box = grip.patch.within(views[0].camera.width, views[0].camera.height)
        return rigid_path(patch_points(views, box))
    if grip.colour is not None:
        return translated(colour_middles(views, grip.colour))
    if grip.log is not None:
        log = read_log(grip.log, grip.log_pose, grip.log_episode)
        if log.turns is None:
            warnings.append(
                f"{grip.log.name} ({log.told}) says no rotation: the gripper is taken not to turn"
            )
        frame = None if grip.log_base is None else LogFrame.of_base(grip.log_base, turned)
        return logged(log.times - grip.log_delay_s, log.places, log.turns, times, frame)
    raise TrackingFailed("what tells the gripper's motion? A marker, a patch, a colour or a log")


def gripper_controllers(
    view: View,
    grip: GripFrom,
    path: RigidPath,
    followed: Followed,
    warnings: list[str],
    margin: Callable[[Array], Array | float] = lambda held: GRIP_MARGIN_M,
) -> tuple[Array, list[dict[str, Any]]]:
    """Controllers (T, K, 3) [m], and the entry of ``grips``.

    Args:
        view: the first camera.
        grip: what it holds.
        path: of the gripper.
        followed: the object.
        warnings: what is not said is added.
        margin: around what a box in the picture shows, a number or (3,) [m], by which pixels that is, (H, W) bool.

    Raises:
        SceneInvalid: the box around what is held shows nothing of the object.
    """
    region = None if grip.held_m is None else np.array(grip.held_m, dtype=np.float64)
    if grip.held_px is not None:
        box = grip.held_px.within(view.camera.width, view.camera.height)
        window = np.zeros((view.camera.height, view.camera.width), dtype=bool)
        window[box.top : box.bottom, box.left : box.right] = True
        mask = followed.masks[0]
        shown = window & mask if mask.size else window
        held = cloud_of(view.camera, view.depth(0), shown)[0]
        if len(held) < LEAST_HELD_PX:
            raise refused(
                "held", f"the box around what is held has {len(held)} pixels of the object with depth"
            )
        around = margin(shown)
        region = np.stack([held.min(axis=0) - around, held.max(axis=0) + around])
    if region is not None:
        corners = np.array(
            [[region[i, 0], region[j, 1], region[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        )
        entry = {"region_min_m": region[0].tolist(), "region_max_m": region[1].tolist()}
        return path.carry(corners), [{"controllers": list(range(8)), **entry}]
    controllers = path.carry(path.reference)
    gap = np.linalg.norm(followed.cloud[:, None] - controllers[0][None], axis=2).min()
    size = float(np.linalg.norm(np.ptp(followed.cloud, axis=0)))
    radius = float(gap + REACH_SHARE * size)
    warnings.append(
        f"what the gripper holds is not said: all within {radius:.3g} m of what was followed on it is taken"
    )
    return controllers, [{"controllers": list(range(len(controllers[0]))), "radius_m": radius}]
