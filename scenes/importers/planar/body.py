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
from physworld_scenes.importers.gripping import GripFrom, gripper_path
from physworld_scenes.importers.planar.place import Placed, straight_box

RODS, SHEETS, SOLIDS = ("rope", "rod", "branched_rope"), ("sheet",), ("beam", "block", "blob", "toy")
MOST_FILLING, LAYERS = 20_000, 3
GRIP_MARGIN_PX = 3.0
REACH_SHARE = 0.1
"""Of the object's size, beyond the nearest point: what a gripper holds where nobody says."""
LEAST_HELD_PX = 4


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


def gripper_way(placed: Placed, small: View, factor: float, grip: GripFrom, times: Array) -> RigidPath:
    """The gripper's motion [m]; a log is in the scene's world already.

    Args:
        placed: the recording on its plane.
        small: the same with lengths ``factor`` times as long.
        factor: see there.
        grip: what tells it, in the picture without distortion.
        times: of the frames [s], (T,).
    """
    if grip.log is not None:
        return gripper_path([placed.view], grip, times)
    way = gripper_path([small], grip, times)
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
    size = float(np.linalg.norm(np.ptp(followed.cloud, axis=0)))
    region = None if grip.held_m is None else np.array(grip.held_m, dtype=np.float64)
    if grip.held_px is not None:
        camera, mask = placed.view.camera, followed.masks[0]
        box = grip.held_px.within(camera.width, camera.height)
        window = np.zeros_like(mask)
        window[box.top : box.bottom, box.left : box.right] = True
        held = cloud_of(camera, placed.view.depth(0), window & mask)[0]
        if len(held) < LEAST_HELD_PX:
            raise refused("held", f"the box around what is held has {len(held)} pixels of the object")
        margin = GRIP_MARGIN_PX * placed.pixel_m(window & mask)
        across = (2.0 * behind + margin) * np.abs(placed.axes[2])
        region = np.stack([held.min(axis=0) - margin - across, held.max(axis=0) + margin + across])
    if region is not None:
        corners = np.array(
            [[region[i, 0], region[j, 1], region[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        )
        entry = {"region_min_m": region[0].tolist(), "region_max_m": region[1].tolist()}
        return way.carry(corners), [{"controllers": list(range(8)), **entry}]
    controllers = way.carry(way.reference)
    gap = np.linalg.norm(followed.cloud[:, None] - controllers[0][None], axis=2).min()
    radius = float(gap + REACH_SHARE * size)
    warnings.append(
        f"what the gripper holds is not said: all within {radius:.3g} m of what was followed on it is taken"
    )
    return controllers, [{"controllers": list(range(len(controllers[0]))), "radius_m": radius}]
