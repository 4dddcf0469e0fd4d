"""The world of a scene that is made of pictures: z up, over the ground that the first frame shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from physworld.arrays import Array
from physworld.tracking.ground import Plane, ground_plane, world_over
from physworld.tracking.view import Box, View, cloud_of
from physworld_scenes.errors import refused
from physworld_scenes.importers.axes import ROTATION_FROM_UP, axis_along
from physworld_scenes.importers.pictures import Pictures

LEVEL_DEG = 15.0


def upright(
    recording: Pictures, up: str | None, boxes: Mapping[int, Box], warnings: list[str]
) -> tuple[Pictures, Plane | None, str]:
    """The recording in the scene's world, its ground, and how up was found.

    Args:
        recording: its first frame is looked at.
        up: axis of the cameras' world that points up; None: the ground's normal, or a guess from the cameras.
        boxes: around the object in the first picture, by camera number: the ground is outside.
        warnings: what was guessed is added.

    Raises:
        SceneInvalid: there is no such axis.
    """
    if up is not None and up not in ROTATION_FROM_UP:
        raise refused("up", f"{up!r}; known: {', '.join(ROTATION_FROM_UP)}")
    outside = [_outside(view, boxes.get(number)) for number, view in enumerate(recording.views)]
    if not recording.placed and up is None:
        plane = ground_plane(outside[0], np.array([0.0, -1.0, 0.0]), np.zeros(3))
        if plane is not None:
            views = [_in_world(view, world_over(plane, view.camera)) for view in recording.views]
            found = Plane(np.array([0.0, 0.0, 1.0]), 0.0, plane.share, plane.spread_m)
            return replace(recording, views=views), found, "the normal of the ground in the first picture"
        warnings.append("no ground is seen: up is taken to be up in the picture; --up names another axis")
    axis, how = up, "given"
    if axis is None:
        # a camera's picture is upright, or it looks down
        ups = [
            -(v.camera.world_to_camera[1, :3] + 0.7 * v.camera.world_to_camera[2, :3])
            for v in recording.views
        ]
        axis = axis_along(np.mean(ups, axis=0)) if recording.placed else "-y"
        how = "guessed from how the cameras stand"
        if axis != "z":
            warnings.append(
                f"up is guessed to be {axis} of the cameras' world, which is turned; --up names another"
            )
    turn = np.eye(4)
    turn[:3, :3] = ROTATION_FROM_UP[axis].T
    views = [_in_world(view, view.camera.world_to_camera @ turn) for view in recording.views]
    points = np.concatenate(outside) @ ROTATION_FROM_UP[axis].T
    eyes = [np.tile(view.camera.centre, (len(own), 1)) for view, own in zip(views, outside, strict=True)]
    plane = ground_plane(points, np.array([0.0, 0.0, 1.0]), np.concatenate(eyes))
    if plane is not None:
        off = float(np.degrees(np.arccos(np.clip(plane.normal[2], -1, 1))))
        if off > LEVEL_DEG:
            plane = None
        elif off > 2.0:
            warnings.append(f"the ground is tilted by {off:.1f} degrees against z of the cameras' world")
    return replace(recording, views=views), plane, f"{axis} of the cameras' world, {how}"


def _outside(view: View, box: Box | None) -> Array:
    """Places (P, 3) [m] of the first picture outside of the object's box, every third pixel."""
    depth = view.depth(0)
    mask = np.zeros(depth.shape, dtype=bool)
    mask[::3, ::3] = True
    if box is not None:
        mask[max(box.top, 0) : max(box.bottom, 0), max(box.left, 0) : max(box.right, 0)] = False
    return cloud_of(view.camera, depth, mask)[0]


def _in_world(view: View, world_to_camera: Array) -> View:
    return replace(view, camera=replace(view.camera, world_to_camera=world_to_camera))
