"""Import of a depth camera's pictures: a folder of colours and depth to a scene, on a CPU.

What a person says: where the object is in the first picture (a box or a mask), what moves the gripper (a marker on
it, a picked patch, its colour, or a robot's log) and what it holds. What is found: the ground and which way is up, the
object's pixels, points on it and their tracks, the gripper's path, the cloud of the first frame, the noise. What
was found or guessed stands in the scene's notes.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.errors import TrackingFailed
from physworld.scene import Scene
from physworld.tracking.grips import (
    RigidPath,
    colour_middles,
    joined,
    logged,
    marker_corners,
    rigid_path,
    translated,
)
from physworld.tracking.ground import Plane, ground_plane, world_over
from physworld.tracking.mask import Box
from physworld.tracking.points import TrackConfig, follow
from physworld.tracking.recording import Followed, follow_all, masks_of
from physworld.tracking.view import View, cloud_of
from physworld_scenes.bundle import checked, scene_from_parts
from physworld_scenes.importers.axes import ROTATION_FROM_UP, axis_along
from physworld_scenes.importers.options import ImportOptions, estimate_noise, split_of
from physworld_scenes.importers.pictures import Pictures, read_pictures, refused

DEFAULT_KIND, DEFAULT_FPS = "blob", 30.0
GROUND_NEAR_M = 0.05
"""From the object's lowest point: a ground that is farther away is none of the scene."""
LEVEL_DEG = 15.0
GRIP_MARGIN_M = 0.01
MOST_LOG_BYTES = 64 << 20
UNSEEN_WARNING = 0.1

Told = Callable[[int, int, str], None]


@dataclass(frozen=True)
class GripFrom:
    """What tells the gripper's motion; one of the first four.

    Attributes:
        marker: number of an ArUco or AprilTag marker on it; -1: the first that is seen.
        dictionary: of the marker.
        patch: a box on it in the first camera's first picture: its texture is followed.
        colour: column and row of a pixel of its colour there; such a gripper does not turn.
        log: CSV of a robot with a head: t, x, y, z and, if it turns, qw, qx, qy, qz; the scene's world, SI units.
        log_delay_s: of the pictures' clock behind the log's.
        held_px: a box around what it holds of the object, in the same picture.
        held_m: instead, the corners of a box of undeformed material [m], (2, 3), in the scene's world.
    """

    marker: int | None = None
    dictionary: str = "4X4_50"
    patch: Box | None = None
    colour: tuple[int, int] | None = None
    log: Path | None = None
    log_delay_s: float = 0.0
    held_px: Box | None = None
    held_m: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None


@dataclass(frozen=True)
class PictureOptions:
    """What a person says of a folder of pictures.

    Attributes:
        boxes: around the object in the first picture, by camera number.
        masks: files of masks that somebody made, white on the object, by camera number.
        grip: what tells the gripper's motion; None: nothing grips.
        up: axis of the cameras' world that points up; None: guessed, or from the ground.
        depth_scale: depth values a metre.
        first, last: frames, half-open; None: to the end.
        points: to follow in each camera.
        undeformed: whether the first frame shows the body undeformed and at rest.
    """

    boxes: dict[int, Box] = field(default_factory=dict)
    masks: dict[int, Path] = field(default_factory=dict)
    grip: GripFrom | None = None
    up: str | None = None
    depth_scale: float | None = None
    first: int = 0
    last: int | None = None
    points: int = TrackConfig.points
    undeformed: bool = False


def read_folder(
    folder: Path,
    options: ImportOptions | None = None,
    pictures: PictureOptions | None = None,
    told: Told = lambda done, total, message: None,
) -> tuple[Scene, list[str], Followed]:
    """The scene in a folder of pictures, its warnings, and what was followed.

    Args:
        folder: one of the layouts of :mod:`physworld_scenes.importers.pictures`.
        options: name, kind, rate, noise, gravity, body.
        pictures: see there.
        told: progress: frames done, frames in all, a message.

    Raises:
        SceneInvalid: files are missing or damaged, or the object or its gripper cannot be followed; with the numbers.
    """
    options, given = options or ImportOptions(), pictures or PictureOptions()
    recording = read_pictures(folder, given.depth_scale, slice(given.first, given.last))
    warnings: list[str] = []
    try:
        recording, ground, up = _upright(recording, given, warnings)
        views = recording.views
        boxes = [given.boxes.get(number) for number in range(len(views))]
        made = [mask_file(given.masks.get(number), view.camera) for number, view in enumerate(views)]
        masks = masks_of(views, boxes, made, None if ground is None else ground.height)
        followed = follow_all(views, masks, TrackConfig(points=given.points), told)
        fps = options.fps or recording.fps
        if fps is None:
            fps = DEFAULT_FPS
            warnings.append(f"the folder says no rate: {fps:g} frames per second are assumed")
        times = np.arange(views[0].frames) / fps
        path = None if given.grip is None else gripper_path(views, given.grip, times)
    except TrackingFailed as error:
        raise refused(folder.name, str(error)) from error
    declared, arrays = _parts(folder, options, given, recording, followed, path, ground, fps, warnings)
    declared["notes"] |= {"up": up, "layout": recording.layout}
    scene, found = checked(scene_from_parts(declared, arrays))
    return scene, warnings + found, followed


def _upright(
    recording: Pictures, given: PictureOptions, warnings: list[str]
) -> tuple[Pictures, Plane | None, str]:
    """The recording in a world with z up, its ground, and how up was found."""
    first = recording.views[0]
    if given.up is not None and given.up not in ROTATION_FROM_UP:
        raise refused("up", f"{given.up!r}; known: {', '.join(ROTATION_FROM_UP)}")
    outside = _outside(first, given.boxes.get(0))
    if not recording.placed and given.up is None:
        plane = ground_plane(outside, np.array([0.0, -1.0, 0.0]), np.zeros(3))
        if plane is not None:
            views = [_in_world(view, world_over(plane, view.camera)) for view in recording.views]
            found = Plane(np.array([0.0, 0.0, 1.0]), 0.0, plane.share, plane.spread_m)
            return replace(recording, views=views), found, "the normal of the ground in the first picture"
        warnings.append("no ground is seen: up is taken to be up in the picture; --up names another axis")
    axis, how = given.up, "given"
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
    points = outside @ ROTATION_FROM_UP[axis].T
    plane = ground_plane(points, np.array([0.0, 0.0, 1.0]), views[0].camera.centre)
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


def mask_file(path: Path | None, camera: Camera) -> Array | None:
    from PIL import Image

    if path is None:
        return None
    try:
        with Image.open(path, formats=("PNG",)) as picture:
            if picture.size != (camera.width, camera.height):
                raise refused(
                    path.name, f"has {picture.size} pixels, the camera {camera.width, camera.height}"
                )
            return np.asarray(picture.convert("L")) > 127
    except (OSError, ValueError, SyntaxError) as error:
        raise refused(path.name, f"is no mask: {str(error)[:160]}") from error


def gripper_path(views: list[View], grip: GripFrom, times: Array) -> RigidPath:
    """The gripper's motion from what tells it."""
    if grip.marker is not None:
        number = None if grip.marker < 0 else grip.marker
        corners = []
        for view in views:
            try:
                corners.append(marker_corners(view, number, grip.dictionary))
            except TrackingFailed:
                if view is views[-1] and not corners:
                    raise
        return rigid_path(joined(corners))
    if grip.patch is not None:
        mask = np.zeros((views[0].camera.height, views[0].camera.width), dtype=bool)
        box = grip.patch.within(views[0].camera.width, views[0].camera.height)
        mask[box.top : box.bottom, box.left : box.right] = True
        tracks = follow(views[0], mask, TrackConfig(points=60))
        return rigid_path(np.where(tracks.visible[..., None], tracks.points, np.nan))
    if grip.colour is not None:
        return translated(colour_middles(views[0], grip.colour))
    if grip.log is not None:
        clock, places, quaternions = _log(grip.log)
        return logged(clock - grip.log_delay_s, places, quaternions, times)
    raise TrackingFailed("what tells the gripper's motion? A marker, a patch, a colour or a log")


def _log(path: Path) -> tuple[Array, Array, Array | None]:
    """Times (L,) [s], places (L, 3) [m] and quaternions (L, 4), scalar first, or None, of a robot's log."""
    if path.stat().st_size > MOST_LOG_BYTES:
        raise refused(path.name, f"has {path.stat().st_size} bytes, at most {MOST_LOG_BYTES} are read")
    with path.open(newline="", encoding="utf-8", errors="replace") as stream:
        reader = csv.reader(stream)
        head = [name.strip().lower() for name in next(reader, [])]
        wanted = ["t", "x", "y", "z"]
        turning = ["qw", "qx", "qy", "qz"]
        missing = [name for name in wanted if name not in head]
        if missing:
            raise refused(path.name, f"has no column {', '.join(missing)}; it has {', '.join(head)[:160]}")
        columns = [head.index(n) for n in (wanted + turning if set(turning) <= set(head) else wanted)]
        try:
            rows = np.array([[float(row[c]) for c in columns] for row in reader if row], dtype=np.float64)
        except (ValueError, IndexError) as error:
            raise refused(path.name, f"holds what is no number: {str(error)[:160]}") from error
    if len(rows) < 2 or not np.isfinite(rows).all() or (np.diff(rows[:, 0]) <= 0).any():
        raise refused(path.name, f"holds {len(rows)} rows; finite ones in the order of time are needed")
    turns = rows[:, 4:8] if rows.shape[1] == 8 else None
    if turns is not None and (np.abs(np.linalg.norm(turns, axis=1) - 1.0) > 1e-2).any():
        raise refused(path.name, "holds quaternions that are not of length 1")
    return rows[:, 0], rows[:, 1:4], turns


def _parts(
    folder: Path,
    options: ImportOptions,
    given: PictureOptions,
    recording: Pictures,
    followed: Followed,
    path: RigidPath | None,
    ground: Plane | None,
    fps: float,
    warnings: list[str],
) -> tuple[dict[str, Any], dict[str, Array]]:
    """What ``scene.json`` and ``scene.npz`` hold."""
    points, visible = followed.points, followed.visible
    controllers, grips = np.zeros((len(points), 0, 3)), None
    if path is not None and given.grip is not None:
        controllers, grips = _controllers(recording.views[0], given.grip, path, followed, warnings)
    noise = options.noise_sigma_m or estimate_noise(points, visible)
    lowest = float(np.nanmin(np.where(visible, points[..., 2], np.nan)))
    near = ground is not None and lowest < ground.height + GROUND_NEAR_M
    unseen = 1.0 - float(visible.mean())
    declared = {
        "schema_version": 1,
        "name": options.name or folder.resolve().name or "recording",
        "kind": options.kind or DEFAULT_KIND,
        "description": "tracked in pictures of depth cameras",
        "fps": float(fps),
        "gravity_m_s2": list(options.gravity_m_s2),
        "noise_sigma_m": noise,
        "split": split_of(len(points)),
        "initial_state": "undeformed and at rest at t=0; gravity acts from t=0" if given.undeformed else "as measured",
        "body": dict(options.body),
        "ground": {"height_m": ground.height, "friction": None} if ground is not None and near else None,
        "grips": grips,
        "notes": {
            "source": {"format": "RGB-D pictures", "cameras": len(recording.views)},
            "points_a_camera": np.bincount(followed.cameras, minlength=len(recording.views)).tolist(),
            "points_seen_share": round(1.0 - unseen, 4),
            "object_pixels": [int(mask.sum()) for mask in followed.masks],
            "ground": None if ground is None else {
                "height_m": ground.height, "share_of_pixels": ground.share, "spread_m": ground.spread_m,
            },
            "gripper": None if path is None else {
                "frames_seen": int(path.seen.sum()), "deviation_from_rigid_m": path.misfit_m,
            },
            "noise": "given" if options.noise_sigma_m else "upper estimate from third differences",
        },
    }  # fmt: skip
    arrays = {
        "points": np.where(np.isfinite(points), points, 0.0),
        "visible": visible,
        "controllers": controllers,
        "times": np.arange(len(points)) / fps,
        "surface_points": followed.cloud,
        "colors": followed.colours,
        "tracked_by_camera": followed.cameras,
    }
    if path is not None and (missing := 1.0 - float(path.seen.mean())) > UNSEEN_WARNING:
        warnings.append(f"the gripper is not seen in {missing:.0%} of the frames, where it is interpolated")
    return declared, arrays


def _controllers(
    view: View, grip: GripFrom, path: RigidPath, followed: Followed, warnings: list[str]
) -> tuple[Array, list[dict[str, Any]]]:
    """Controllers (T, K, 3) [m], and the entry of ``grips``."""
    region = None if grip.held_m is None else np.array(grip.held_m, dtype=np.float64)
    if grip.held_px is not None:
        box = grip.held_px.within(view.camera.width, view.camera.height)
        window = np.zeros((view.camera.height, view.camera.width), dtype=bool)
        window[box.top : box.bottom, box.left : box.right] = True
        mask = followed.masks[0]
        held = cloud_of(view.camera, view.depth(0), window & mask if mask.size else window)[0]
        if len(held) < 4:
            raise refused(
                "held", f"the box around what is held has {len(held)} pixels of the object with depth"
            )
        region = np.stack([held.min(axis=0) - GRIP_MARGIN_M, held.max(axis=0) + GRIP_MARGIN_M])
    if region is not None:
        corners = np.array(
            [[region[i, 0], region[j, 1], region[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        )
        entry = {
            "controllers": list(range(8)),
            "region_min_m": region[0].tolist(),
            "region_max_m": region[1].tolist(),
        }
        return path.carry(corners), [entry]
    controllers = path.carry(path.reference)
    gap = np.linalg.norm(followed.cloud[:, None] - controllers[0][None], axis=2).min()
    size = float(np.linalg.norm(np.ptp(followed.cloud, axis=0)))
    radius = float(gap + 0.1 * size)
    warnings.append(
        f"what the gripper holds is not said: all within {radius:.3f} m of the points that were followed on it is taken"
    )
    return controllers, [{"controllers": list(range(len(controllers[0]))), "radius_m": radius}]
