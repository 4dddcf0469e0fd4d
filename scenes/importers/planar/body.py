"""What one camera does not see of the object and is told: how thick it is, and what holds it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.tracking.recording import Followed, thinned
from physworld.tracking.rigid import RigidPath
from physworld.tracking.view import View, cloud_of
from physworld_scenes.errors import refused
from physworld_scenes.importers.film import Filmed
from physworld_scenes.importers.gripping import GripFrom, gripper_controllers, gripper_path
from physworld_scenes.importers.planar.place import Placed, straight_box

RODS, SHEETS, SOLIDS = ("rope", "rod", "branched_rope"), ("sheet",), ("beam", "block", "blob", "toy")
MOST_FILLING, LAYERS = 20_000, 3
GRIP_MARGIN_PX = 3.0


def behind_m(kind: str, body: dict[str, Any]) -> float:
    """How far the object reaches behind the plane of its points [m]: of a solid, whose front is seen, all of its
    thickness; of a sheet half of it; of a rope its radius; 0: not said.

    Raises:
        SceneInvalid: a solid of which nobody said a thickness.
    """
    if kind in RODS:
        return float(body.get("radius_m") or 0.0)
    thickness = float(body.get("thickness_m") or 0.0)
    if kind in SHEETS:
        return 0.5 * thickness
    if kind in SOLIDS and not thickness and "box_min_m" not in body:
        raise refused(
            "thickness",
            f"one camera does not see how thick a {kind} is: give body.thickness_m, or box_min_m and box_max_m",
        )
    return thickness


def filling(kind: str, placed: Placed, mask: Array, behind: float) -> Array | None:
    """Points (M, 3) [m] that fill what is seen of a solid, as thick as was said; None: of others.

    Args:
        kind: of the object.
        placed: the recording on its plane.
        mask: the object in the first picture, (H, W) bool.
        behind: how far it reaches behind the plane [m].
    """
    if kind in RODS + SHEETS or not behind:
        return None
    camera, depth = placed.view.camera, placed.view.depth(0)
    seen = cloud_of(camera, depth, mask)[0]
    area = float(np.sum(depth[mask].astype(np.float64) ** 2)) / (camera.fx * camera.fy)
    area /= float(np.cos(np.radians(placed.plane.tilt_deg)))
    cell = max(behind / LAYERS, float(np.cbrt(area * behind / MOST_FILLING)))
    count = max(2, round(behind / cell))
    flat = thinned((seen - seen[0]) @ placed.axes.T, cell) @ placed.axes + seen[0]
    depths = (np.arange(count) + 0.5) / count * behind
    layers: Array = (flat[None] - depths[:, None, None] * placed.axes[2]).reshape(-1, 3)
    return layers


def gripper_way(
    placed: Placed, small: View, factor: float, grip: GripFrom, times: Array, warnings: list[str]
) -> RigidPath:
    """The gripper's motion [m]; a log, or the robot's base that it is told in, is in the scene's world already.

    Args:
        placed: the recording on its plane.
        small: the same with lengths ``factor`` times as long.
        factor: see there.
        grip: what tells it, in the picture without distortion.
        times: of the frames [s], (T,).
        warnings: what a log does not say is added.
    """
    if grip.log is not None:
        return gripper_path([placed.view], grip, times, warnings)
    way = gripper_path([small], grip, times, warnings)
    return replace(
        way,
        places=way.places / factor,
        reference=way.reference / factor,
        misfit_m=way.misfit_m / factor,
        draws=way.draws / np.repeat([1.0, factor], 3),
    )


def straight_grip(filmed: Filmed, grip: GripFrom) -> GripFrom:
    """What was said of the gripper, in the picture without distortion."""
    colour = grip.colour
    if colour is not None:
        moved = filmed.straight(np.array([colour], dtype=np.float64) + 0.5)[0]
        colour = (int(moved[0]), int(moved[1]))
    return replace(
        grip,
        patch=None if grip.patch is None else straight_box(filmed, grip.patch),
        held_px=None if grip.held_px is None else straight_box(filmed, grip.held_px),
        colour=colour,
    )


def controllers_of(
    placed: Placed, grip: GripFrom, way: RigidPath, followed: Followed, behind: float, warnings: list[str]
) -> tuple[Array, list[dict[str, Any]]]:
    """Controllers (T, K, 3) [m], and the entry of ``grips``.

    Args:
        placed: the recording on its plane.
        grip: what is held, in the picture without distortion.
        way: the gripper's.
        followed: the object.
        behind: how far it reaches behind the plane [m].
        warnings: what was guessed is added.

    Raises:
        SceneInvalid: the box around what is held shows nothing of the object.
    """

    def margin(held: Array) -> Array:
        near = GRIP_MARGIN_PX * placed.pixel_m(held)
        around: Array = near + (2.0 * behind + near) * np.abs(placed.axes[2])
        return around

    return gripper_controllers(placed.view, grip, way, followed, warnings, margin)
