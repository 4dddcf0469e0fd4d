"""Import of one colour camera's film of a motion in a plane: a rope or beam before a board, a strip on a table.

What a person says: what tells the plane (a printed board, or two pixels whose distance is known), which way is up,
where the object is, what moves the gripper, and the thickness that a camera cannot see from the front. The plane stands
in for a depth camera: points are followed in the pictures and put onto the plane by its homography. **Motion out of the
plane is not seen.** It changes the distances between neighbouring points as a stretch does, and that is reported.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.scene import Scene, sigma_of
from physworld.tracking.places import TrackConfig
from physworld.tracking.plane import TRACKING_PIXEL_M, scaled, stretch
from physworld.tracking.recording import Followed, Masks, follow_all
from physworld.tracking.rigid import RigidPath
from physworld_scenes.bundle import checked, scene_from_parts
from physworld_scenes.errors import refused
from physworld_scenes.importers.film import Filmed, read_film
from physworld_scenes.importers.options import ImportOptions, estimate_noise, split_of
from physworld_scenes.importers.planar.body import (
    behind_m,
    controllers_of,
    filling,
    gripper_way,
    straight_grip,
)
from physworld_scenes.importers.planar.place import Placed, PlaneFrom, mask_of, placed_on, require_plausible
from physworld_scenes.importers.rgbd import (
    DEFAULT_FPS,
    DEFAULT_KIND,
    UNSEEN_WARNING,
    PictureOptions,
    Told,
    in_stage,
)

STRETCH_WARNING = 0.03
LEAST_NOISE_PX = 0.05
"""Films repeat what hardly changes, so that places at rest differ by nothing; no patch is found better than this."""
ACROSS_SHARE, ACROSS_MOST = 0.01, 500.0
"""Across the plane: a hundredth of its distance from the camera, by which a body can leave it before lengths in the
picture tell, and at most so many times the noise in the plane."""
DESCRIPTION = (
    "tracked in the pictures of one camera, on a declared plane; motion out of the plane is not seen"
)


def read_planar(
    path: Path,
    options: ImportOptions | None = None,
    pictures: PictureOptions | None = None,
    plane: PlaneFrom | None = None,
    told: Told = lambda done, total, message: None,
) -> tuple[Scene, list[str], Followed]:
    """The scene in a film, its warnings, and what was followed.

    Args:
        path: a film, or a folder of pictures.
        options: name, kind, rate, noise, gravity, body.
        pictures: the object, its gripper, frames; ``up`` is an axis of the plane: x right and y up in the picture,
            z towards the camera.
        plane: see there.
        told: progress of the stages of :mod:`physworld_scenes.importers.rgbd`.

    Raises:
        SceneInvalid: the film is damaged, or plane, object or gripper cannot be found or followed; with the numbers.
    """
    options, given, told_plane = (
        options or ImportOptions(),
        pictures or PictureOptions(),
        plane or PlaneFrom(),
    )
    warnings: list[str] = []
    kind = options.kind or DEFAULT_KIND
    behind = behind_m(kind, options.body)
    told(0, 1, "reading")
    filmed = read_film(path, told_plane.lens, slice(given.first, given.last))
    try:
        placed = placed_on(filmed, told_plane, given.up, warnings)
        mask = mask_of(filmed, placed, given)
        require_plausible(placed, mask, told_plane)
        factor = TRACKING_PIXEL_M / placed.pixel_m(mask)
        small = scaled(placed.view, factor)
        config, telling = TrackConfig(points=given.points), in_stage("tracking", told)
        followed = follow_all([small], Masks([mask], {}, []), config, telling)
        followed = _unscaled(followed, placed, factor)
        times, fps = _times(filmed, options, warnings)
        told(0, 1, "gripping")
        gripper = None if given.grip is None else straight_grip(filmed, given.grip)
        way = None if gripper is None else gripper_way(placed, small, factor, gripper, times, warnings)
    except TrackingFailed as error:
        raise refused(path.name, str(error)) from error
    told(0, 1, "scene")
    controllers, grips, errors = np.zeros((len(times), 0, 3)), None, np.zeros((0, len(times), 0, 3))
    if gripper is not None and way is not None:
        controllers, grips = controllers_of(placed, gripper, way, followed, behind, warnings)
        errors = way.errors(controllers[0], followed.cloud)
    placed.facts["lengths"] = _lengths(followed, placed, warnings)
    declared = _declared(path, options, given, placed, followed, way, fps, behind)
    declared["grips"] = grips
    arrays = {
        "points": np.where(np.isfinite(followed.points), followed.points, 0.0),
        "visible": followed.visible,
        "controllers": controllers,
        "times": times,
        "surface_points": followed.cloud,
        "colors": followed.colours,
    }
    if len(errors):
        arrays["controller_errors"] = errors
    if (in_plane := declared["notes"]["noise_in_plane_m"]) is not None:
        across = float(np.clip(ACROSS_SHARE * placed.distance_m, in_plane, ACROSS_MOST * in_plane))
        arrays["noise_covariance"] = planar_covariances(
            followed.points.shape[1], placed.axes, in_plane, across
        )
        declared["noise_sigma_m"] = sigma_of(arrays["noise_covariance"])
    filled = filling(kind, placed, mask, behind)
    if filled is not None:
        arrays["rest_volume_points"] = filled
    if way is not None and (missing := 1.0 - float(way.seen.mean())) > UNSEEN_WARNING:
        warnings.append(f"the gripper is not seen in {missing:.0%} of the frames, where it is interpolated")
    scene, found = checked(scene_from_parts(declared, arrays))
    return scene, warnings + found, followed


def _unscaled(followed: Followed, placed: Placed, factor: float) -> Followed:
    """What was followed, in metres; points that are seen exactly where the homography puts their pixels."""
    places = placed.places(followed.pixels)
    seen = followed.visible & np.isfinite(places).all(axis=2)
    return replace(
        followed,
        points=np.where(seen[..., None], places, followed.points / factor),
        visible=seen,
        cloud=followed.cloud / factor,
        views=[placed.view],
    )


def _times(filmed: Filmed, options: ImportOptions, warnings: list[str]) -> tuple[Array, float]:
    """Moments (T,) [s] and frames per second."""
    if options.fps is None and filmed.times is not None:
        return filmed.times, (len(filmed.times) - 1) / float(filmed.times[-1])
    if options.fps is None:
        warnings.append(f"pictures say no rate: {DEFAULT_FPS:g} frames per second are assumed")
    fps = options.fps or DEFAULT_FPS
    return np.arange(filmed.view.frames) / fps, fps


def _lengths(followed: Followed, placed: Placed, warnings: list[str]) -> dict[str, Any] | None:
    """How the distances between neighbouring points change: by stretch, or by motion out of the plane."""
    ratios = stretch(followed.points, followed.visible)
    if not np.isfinite(ratios).any():
        return None
    worst = int(np.nanargmax(np.abs(ratios - 1.0)))
    ratio = float(ratios[worst])
    if abs(ratio - 1.0) > STRETCH_WARNING:
        away = (
            f"{1e3 * placed.distance_m * (1.0 - 1.0 / ratio):.3g} mm towards the camera"
            if ratio > 1.0
            else f"turned out of the plane by {np.degrees(np.arccos(ratio)):.0f} degrees"
        )
        warnings.append(
            f"distances between neighbouring points are {ratio:.3f} times those of the first frame in frame {worst}: "
            f"the object stretches, or it is {away}, which this import does not see"
        )
    return {
        "least": round(float(np.nanmin(ratios)), 4),
        "most": round(float(np.nanmax(ratios)), 4),
        "frame": worst,
    }


def _declared(
    path: Path,
    options: ImportOptions,
    given: PictureOptions,
    placed: Placed,
    followed: Followed,
    way: RigidPath | None,
    fps: float,
    behind: float,
) -> dict[str, Any]:
    """What ``scene.json`` holds, but its grips."""
    noise, how = _noise(options, placed, followed)
    return {
        "schema_version": 1,
        "name": options.name or path.stem or "film",
        "kind": options.kind or DEFAULT_KIND,
        "description": DESCRIPTION,
        "fps": float(fps),
        "gravity_m_s2": list(options.gravity_m_s2),
        "noise_sigma_m": None,
        "split": split_of(len(followed.points)),
        "initial_state": "undeformed and at rest at t=0; gravity acts from t=0" if given.undeformed else "as measured",
        "body": dict(options.body),
        "ground": {"height_m": -(placed.facts["before_m"] or behind), "friction": None} if placed.up == "z" else None,
        "notes": {
            "source": {"format": "film of a motion in a plane", "cameras": 1},
            "plane": placed.facts,
            "across_the_plane": "not measured: all points lie on the plane",
            "up": f"{placed.up} of the plane",
            "points_seen_share": round(float(followed.visible.mean()), 4),
            "object_pixels": int(followed.masks[0].sum()),
            "gripper": None if way is None else {
                "frames_seen": int(way.seen.sum()), "deviation_from_rigid_m": way.misfit_m,
            },
            "noise": how,
            "noise_in_plane_m": noise,
        },
    }  # fmt: skip


def planar_covariances(count: int, axes: Array, in_plane_m: float, across_m: float) -> Array:
    """Covariance of a sighting of every point, (N, 3, 3) [m^2]: hardly anything is known across the plane.

    Args:
        count: N.
        axes: of the plane in the world: rows are x, y and z, which is towards the camera, (3, 3).
        in_plane_m, across_m: deviations.
    """
    variances = np.array([in_plane_m, in_plane_m, across_m]) ** 2
    return np.tile(axes.T @ np.diag(variances) @ axes, (count, 1, 1))


def _noise(options: ImportOptions, placed: Placed, followed: Followed) -> tuple[float | None, str]:
    """Deviation per axis of the plane [m], and how it is known."""
    if options.noise_sigma_m:
        return options.noise_sigma_m, "given"
    in_plane = np.flatnonzero(np.abs(placed.axes[2]) < 0.5)
    noise = estimate_noise(followed.points[..., in_plane], followed.visible)
    least = LEAST_NOISE_PX * placed.pixel_m(followed.masks[0])
    if noise is None or noise < least:
        return least, f"in the plane, {LEAST_NOISE_PX:g} px: frames of a film that repeat show none"
    return noise, "in the plane, upper estimate from third differences"
