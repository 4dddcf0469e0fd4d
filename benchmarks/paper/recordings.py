"""Rendered recordings of known truth for the image columns: the plays of ``benchmarks.tracking`` before small cameras.

What three cameras of 320 × 240 px show of the first frame and the first of them of some other frames, which surface
every pixel shows, and the scene that a person would declare, with exact tracks of material points spread over the whole
surface: errors of films are then those of the predictions, of the splat and of its skinning, none of a tracker.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from benchmarks.tracking.depth_camera import DepthCamera
from benchmarks.tracking.plays import FPS, PLAYS, Play, marker_picture
from benchmarks.tracking.raycast import Stage
from physworld.arrays import Array
from physworld.camera import Camera
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.video import SplatView
from physworld.worldmodel.model.graph import farthest_points

TRACKED = 80
NOISE_M = 1e-4
"""Of exact tracks: what the lattice of a fit leaves of them."""
TRAINING_SHARE = 0.7
"""As in the paper."""
SMALLER = 2
"""Times smaller than the pictures of ``benchmarks.tracking``, along each side."""


@dataclass(frozen=True)
class Recording:
    """A play in front of cameras.

    Attributes:
        scene: with exact tracks.
        views: of the first frame, a camera each: its object's pixels and measured depth.
        frames: that have a picture of the first camera, the first frame among them, (F,).
        pictures: with the camera's noise, (F, H, W, 3) uint8.
        seen: surface that the middle of a pixel shows, (F, H, W) int8: 0 the object, -1 none, others may hide it.
    """

    scene: Scene
    views: tuple[SplatView, ...]
    frames: Array
    pictures: Array
    seen: Array

    @property
    def camera(self) -> Camera:
        """Of the pictures."""
        return self.views[0].camera

    def at(self, frame: int) -> int:
        """Row of a frame that has a picture. Raises KeyError."""
        rows = np.flatnonzero(self.frames == frame)
        if not len(rows):
            raise KeyError(f"frame {frame} has no picture, only {self.frames.tolist()} have")
        return int(rows[0])


def judged(scene_frames: int, held_out: int, training: int) -> tuple[list[int], list[int]]:
    """Frames to compare: of the training and of the held-out ones, at these distances from their ends.

    Args:
        scene_frames: T.
        held_out: every so many of the held-out frames.
        training: every so many of the training frames.
    """
    end = round(TRAINING_SHARE * scene_frames)
    return list(range(end - 1, 0, -training))[::-1], list(range(scene_frames - 1, end - 1, -held_out))[::-1]


def record(name: str, count: int, shown: Sequence[int], seed: int = 0) -> Recording:
    """Simulate a play and render the first frame and those of ``shown``.

    Args:
        name: of the play.
        count: frames of the play.
        shown: frames that get a picture.
        seed: of the camera's noise.
    """
    play = PLAYS[name](count)
    stage = Stage(play.surfaces, play.table_m, marker_picture())
    errors = DepthCamera()
    frames = np.array(sorted({0, *shown}))
    views, pictures, seen = [], [], []
    for number, camera in enumerate(_smaller(one) for one in play.cameras):
        rng = np.random.default_rng([seed, number])
        pattern = errors.pattern((camera.height, camera.width), rng)
        for frame in frames if number == 0 else frames[:1]:
            exact, depth, surface = stage.show(play.vertices[frame], camera, int(frame))
            picture = errors.colour(exact, rng)
            if frame == 0:
                measured = errors.depth_mm(depth, camera.fx, pattern, rng) / 1e3
                views.append(SplatView(camera, picture, surface == 0, measured))
            if number == 0:
                pictures.append(picture)
                seen.append(surface.astype(np.int8))
    return Recording(scene_of(name, play), tuple(views), frames, np.stack(pictures), np.stack(seen))


def scene_of(name: str, play: Play, tracked: int = TRACKED) -> Scene:
    """The play as a scene: what a person declares, and the truth of points spread over the object's surface.

    Args:
        name: of the scene.
        play: the motion.
        tracked: how many points.
    """
    surface = play.vertices[:, : play.object_vertices]
    points = surface[:, farthest_points(surface[0], tracked)]
    grip = play.declared["grip"]
    low, high = (np.array(grip[end]) for end in ("region_min_m", "region_max_m"))
    corners = np.array(list(product(*zip(low, high, strict=True))))
    turns, shifts = play.grip_poses
    turned = np.einsum("tij,kj->tki", turns, corners - play.grip_centre)
    inside = np.flatnonzero(((points[0] >= low - 1e-6) & (points[0] <= high + 1e-6)).all(axis=1))
    count = len(points)
    end = round(TRAINING_SHARE * count)
    facts = {
        key: np.array(value) if isinstance(value, list) else value
        for key, value in play.declared["body"].items()
    }
    return Scene(
        name=name,
        kind=play.kind,
        points=points,
        visible=np.ones(points.shape[:2], dtype=bool),
        controllers=turned + play.grip_centre + shifts[:, None],
        times=np.arange(count) / FPS,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=NOISE_M,
        train=(0, end),
        test=(end, count),
        initial_state=UNDEFORMED_AT_REST,
        fps=FPS,
        body=Body(**facts),
        grips=(Grip(tuple(range(len(corners))), low, high, tuple(int(i) for i in inside)),),
        surface_points=surface[0],
        declared={"body": play.declared["body"]},
    )


def _smaller(camera: Camera) -> Camera:
    return replace(
        camera,
        width=camera.width // SMALLER,
        height=camera.height // SMALLER,
        fx=camera.fx / SMALLER,
        fy=camera.fy / SMALLER,
        cx=camera.cx / SMALLER,
        cy=camera.cy / SMALLER,
    )
