"""Import of a depth camera's pictures: a folder of colours and depth to a scene, on a CPU.

What a person says: where the object is in the first picture (a box or a mask), what moves the gripper (a marker on
it, a picked patch, its colour, or a robot's log) and what it holds. What is found: the ground and which way is up, the
object's pixels, points on it and their tracks, the gripper's path, the cloud of the first frame, the noise. What
was found or guessed stands in the scene's notes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.errors import TrackingFailed
from physworld.scene import Scene, sigma_of
from physworld.tracking.agreement import WARNED_APART_M
from physworld.tracking.ground import Plane
from physworld.tracking.hidden_side import body_of_seen_side
from physworld.tracking.middle import onto_middle
from physworld.tracking.noise import sighting_covariances
from physworld.tracking.places import TrackConfig
from physworld.tracking.recording import Followed, Masks, edged_cloud, follow_all, masks_of
from physworld.tracking.rigid import RigidPath
from physworld.tracking.view import Box
from physworld_scenes.bundle import checked, scene_from_parts
from physworld_scenes.errors import refused
from physworld_scenes.importers.given_tracks import read_tracks
from physworld_scenes.importers.gripping import GripFrom, gripper_controllers, gripper_path
from physworld_scenes.importers.options import ImportOptions, estimate_noise, split_of
from physworld_scenes.importers.pictures import Pictures, read_pictures
from physworld_scenes.importers.upright import upright

DEFAULT_KIND, DEFAULT_FPS = "blob", 30.0
ROD_KINDS, SHEET_KINDS = ("rope", "rod", "branched_rope"), ("sheet", "cloth")
SLENDER_KINDS = ("arm", "trunk")
LEAST_FILLING = 20
"""Points that fill a body: with fewer its cloud tells more."""
GROUND_NEAR_M = 0.05
"""From the object's lowest point: a ground that is farther away is none of the scene."""
UNSEEN_WARNING = 0.1

STAGES = ("reading", "tracking", "cloud", "gripping", "scene")
Told = Callable[[int, int, str], None]
"""Told of progress: frames done, frames in all, and a message that begins with the stage and perhaps goes on behind a
comma."""


@dataclass(frozen=True)
class PictureOptions:
    """What a person says of a folder of pictures.

    Attributes:
        boxes: around the object in the first picture, by camera number.
        masks: files of masks that somebody made, white on the object, by camera number.
        tracks: files of another tracker's tracks, by camera number; those in the folder ``tracks`` need not be named.
        grip: what tells the gripper's motion; None: nothing grips.
        up: axis of the cameras' world that points up; None: guessed, or from the ground.
        depth_scale: depth values a metre.
        first, last: frames, half-open; None: to the end.
        points: to follow in each camera.
        undeformed: whether the first frame shows the body undeformed and at rest.
    """

    boxes: dict[int, Box] = field(default_factory=dict)
    masks: dict[int, Path] = field(default_factory=dict)
    tracks: dict[int, Path] = field(default_factory=dict)
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
        told: progress of the ``STAGES``.

    Raises:
        SceneInvalid: files are missing or damaged, or the object or its gripper cannot be followed; with the numbers.
    """
    options, given = options or ImportOptions(), pictures or PictureOptions()
    told(0, 1, "reading")
    recording = read_pictures(folder, given.depth_scale, slice(given.first, given.last))
    warnings: list[str] = []
    for name, named in (("box", given.boxes), ("mask", given.masks), ("tracks", given.tracks)):
        if strange := sorted(set(named) - set(range(len(recording.views)))):
            raise refused(
                name, f"is of camera {strange[0]}; there are {len(recording.views)}, counted from 0"
            )
    tracks = read_tracks(folder, given.tracks, recording, warnings)
    try:
        declared_camera = recording.views[0].camera
        recording, ground, up = upright(recording, given.up, given.boxes, warnings)
        views = recording.views
        turned = np.linalg.inv(views[0].camera.world_to_camera) @ declared_camera.world_to_camera
        boxes = [given.boxes.get(number) for number in range(len(views))]
        made = [mask_file(given.masks.get(number), view.camera) for number, view in enumerate(views)]
        masks = masks_of(views, boxes, made, None if ground is None else ground.height)
        config = TrackConfig(points=given.points)
        followed = follow_all(views, masks, config, in_stage("tracking", told), tracks, estimate_noise)
        told(0, 1, "cloud")
        followed = _as_its_kind(followed, options, config)
        warnings += _disagreements(masks, followed)
        fps = options.fps or recording.fps
        if fps is None:
            fps = DEFAULT_FPS
            warnings.append(f"the folder says no rate: {fps:g} frames per second are assumed")
        times = np.arange(views[0].frames) / fps
        told(0, 1, "gripping")
        path = None if given.grip is None else gripper_path(views, given.grip, times, warnings, turned)
    except TrackingFailed as error:
        raise refused(folder.name, str(error)) from error
    told(0, 1, "scene")
    declared, arrays = _parts(folder, options, given, recording, followed, path, ground, fps, warnings)
    declared["notes"] |= {"up": up, "layout": recording.layout}
    if tracks:
        declared["notes"]["tracks_given"] = sorted(tracks)
    if len(views) > 1:
        declared["notes"]["cameras"] = _cameras(masks, followed)
    scene, found = checked(scene_from_parts(declared, arrays))
    return scene, warnings + found, followed


def in_stage(stage: str, told: Told) -> Told:
    """What tells of a stage whose own messages go behind its name."""
    return lambda done, total, message: told(done, total, f"{stage}, {message}")


def _as_its_kind(followed: Followed, options: ImportOptions, config: TrackConfig) -> Followed:
    """What is thin: the cloud of a rope or sheet reaches to its edges, points of a rope lie on its middle line."""
    kind, radius = options.kind or DEFAULT_KIND, options.body.get("radius_m")
    if kind in ROD_KINDS + SHEET_KINDS:
        followed = replace(followed, cloud=edged_cloud(followed.views, followed.masks))
    if kind not in ROD_KINDS or not isinstance(radius, int | float):
        return followed
    points = onto_middle(
        followed.points,
        followed.visible,
        followed.cameras,
        followed.views,
        followed.masks,
        float(radius),
        config.depth_px,
    )
    return replace(followed, points=points)


def _disagreements(masks: Masks, followed: Followed) -> list[str]:
    """What a person should know of cameras that disagree or show nothing."""
    lines = [f"camera {number} is left out: {reason}" for number, reason in sorted(followed.left_out.items())]
    for one in masks.agreements:
        if one.apart_m is None:
            lines.append(
                f"cameras {one.other} and {one.camera} see no surface together in the first frame: "
                "their places are not compared"
            )
        elif one.apart_m > WARNED_APART_M:
            lines.append(
                f"the first clouds of cameras {one.other} and {one.camera} are {1e3 * one.apart_m:.1f} mm apart"
            )
    return lines


def _cameras(masks: Masks, followed: Followed) -> dict[str, Any]:
    """Notes of several cameras."""
    return {
        "places_counted_once": followed.shared,
        "noise_m": followed.noise_m,
        "clouds_apart_m": {f"{a.other} and {a.camera}": a.apart_m for a in masks.agreements},
        "left_out": {str(number): reason for number, reason in followed.left_out.items()},
    }


def _filled(
    options: ImportOptions, followed: Followed, ground: Plane | None, warnings: list[str]
) -> Array | None:
    """Points (M, 3) [m] above the ground that fill a solid of undeclared shape, its far side as the near one."""
    kind = options.kind or DEFAULT_KIND
    if kind in ROD_KINDS + SHEET_KINDS + SLENDER_KINDS or "box_min_m" in options.body:
        return None
    found = body_of_seen_side(followed.views, followed.masks)
    if found is not None and ground is not None:
        found = found[found[:, 2] >= ground.height]
    if found is None or len(found) < LEAST_FILLING:
        return None
    size = " x ".join(f"{1e2 * side:.1f}" for side in np.ptp(found, axis=0))
    warnings.append(
        f"no camera sees the far side of the body, which is taken as a mirror image of the seen one: {size} cm along "
        "x, y and z; declare its box, or give rest_volume_points, if you know them"
    )
    return found


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
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise refused(path.name, f"is no mask: {str(error)[:160]}") from error


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
    controllers, grips, errors = np.zeros((len(points), 0, 3)), None, np.zeros((0, len(points), 0, 3))
    if path is not None and given.grip is not None:
        controllers, grips = gripper_controllers(recording.views[0], given.grip, path, followed, warnings)
        errors = path.errors(controllers[0], followed.cloud)
    covariances = sighting_covariances(points, visible, followed.cameras, followed.views)
    if covariances is not None and options.noise_sigma_m is not None:
        covariances *= (options.noise_sigma_m / sigma_of(covariances)) ** 2
    noise = options.noise_sigma_m or (None if covariances is None else sigma_of(covariances))
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
                "controllers_err_m": float(np.sqrt((errors**2).sum(axis=0).mean())) if len(errors) else None,
            },
            "noise": "given" if options.noise_sigma_m else "measured along and across the lines of sight",
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
    if covariances is not None:
        arrays["noise_covariance"] = covariances
    if len(errors):
        arrays["controller_errors"] = errors
    if (filled := _filled(options, followed, ground, warnings)) is not None:
        arrays["rest_volume_points"] = filled
    if path is not None and (missing := 1.0 - float(path.seen.mean())) > UNSEEN_WARNING:
        warnings.append(f"the gripper is not seen in {missing:.0%} of the frames, where it is interpolated")
    return declared, arrays
