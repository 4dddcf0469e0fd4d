"""The motion of a marker before noisy depth cameras: a few tenths of a milliradian where depth alone tells several."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.camera import Camera, look_at
from physworld.errors import TrackingFailed
from physworld.tracking.markers import sighted
from physworld.tracking.poses import marker_path
from physworld.tracking.rigid import RigidPath
from physworld.tracking.view import View

pytestmark = pytest.mark.slow

FRAMES, SIDE_M, FINE = 24, 0.05, 4
WIDTH, HEIGHT, DEPTH_NOISE_M, GREY_NOISE = 320, 240, 1.5e-3, 2.0
CAMERAS = [
    look_at(np.array(eye), np.zeros(3), width=WIDTH, height=HEIGHT, field_of_view_deg=30.0)
    for eye in ((0.05, -0.6, 0.2), (0.4, -0.45, 0.1))
]
FAR = np.array([[0.2, 0.0, 0.0]])
"""What a beam of that length would feel [m]."""


def pose(frame: int) -> tuple[Array, Array]:
    """Rotation (3, 3) and shift (3,) [m] of the plate since the first frame."""
    since = frame / FRAMES
    turn = Rotation.from_rotvec(0.25 * np.sin(3.0 * since) * np.array([0.3, 0.5, 1.0])).as_matrix()
    return turn, 0.04 * np.array([np.sin(2.0 * since), 1.0 - np.cos(2.0 * since), np.sin(4.0 * since)])


def plate() -> tuple[Array, Array]:
    """Picture of the marker with its margin, and its corners [m], (4, 3), which looks along -y."""
    picture = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 120)
    whole = cv2.copyMakeBorder(picture, 24, 24, 24, 24, cv2.BORDER_CONSTANT, value=255)
    half = 0.5 * SIDE_M * len(whole) / 120
    return whole, half * np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]])


def view_of(camera: Camera, rng: np.random.Generator, hidden: range = range(0)) -> View:
    """The plate before a grey wall, seen by a camera that errs; covered in some frames."""
    picture, corners = plate()
    frames = []
    for frame in range(FRAMES):
        turn, shift = pose(frame)
        pixels, _ = camera.project(corners @ turn.T + shift)
        size = len(picture)
        ends = np.array([[0, 0], [size, 0], [size, size], [0, size]], np.float32) - 0.5
        matrix = cv2.getPerspectiveTransform(ends, (FINE * pixels - 0.5).astype(np.float32))
        large = (FINE * WIDTH, FINE * HEIGHT)
        shown = cv2.warpPerspective(picture.astype(np.float32), matrix, large, borderValue=90.0)
        grey = cv2.resize(shown, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        if frame in hidden:
            grey[:] = 90.0
        grey = np.clip(grey + rng.normal(scale=GREY_NOISE, size=grey.shape), 0, 255).astype(np.uint8)
        on = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.fillConvexPoly(on, np.round(pixels - 0.5).astype(np.int32), 1)
        rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
        rays = np.stack(
            [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], -1
        )
        rotation, place = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        normal = rotation @ turn @ [0.0, 1.0, 0.0]
        depth = np.where(on > 0, normal @ (rotation @ shift + place) / (rays @ normal), 1.0)
        blurred = cv2.GaussianBlur(rng.normal(size=depth.shape), (0, 0), 1.2) * 2.0 * np.sqrt(np.pi) * 1.2
        frames.append(
            (np.repeat(grey[..., None], 3, axis=2), (depth + DEPTH_NOISE_M * blurred).astype(np.float32))
        )
    return View(camera, colours(frames), lambda frame: frames[frame][1], FRAMES)


def colours(frames: list[tuple[Array, Array]]) -> Callable[[int], Array]:
    return lambda frame: frames[frame][0]


def off_m(path: RigidPath) -> float:
    """Root mean square of the distance from where a point far from the marker is [m]."""
    exact = np.stack([(FAR @ turn.T + shift) for turn, shift in map(pose, range(FRAMES))])
    return float(np.sqrt(np.mean(np.sum((path.carry(FAR) - exact) ** 2, axis=2))))


def test_points_of_the_marker_are_the_same_in_every_frame_to_hundredths_of_a_pixel() -> None:
    seen = sighted([view_of(CAMERAS[0], np.random.default_rng(0))], 7)[0]
    assert seen.seen.all()
    _, corners = plate()
    expected = [
        CAMERAS[0].project(corners * 120 / 168 @ turn.T + shift)[0]
        for turn, shift in map(pose, range(FRAMES))
    ]
    off = seen.pixels - np.array(expected)
    # where the template has its corners is a constant of the plate, which grows and turns with it
    assert np.std(off, axis=0).max() < 0.06
    assert np.abs(off).max() < 0.6


def test_the_far_end_of_a_beam_is_told_to_a_fraction_of_a_millimetre() -> None:
    views = [view_of(camera, np.random.default_rng(number)) for number, camera in enumerate(CAMERAS)]
    one, both = marker_path(views[:1], 7, "4X4_50"), marker_path(views, None, "4X4_50")
    assert one.seen.all() and both.seen.all()
    assert off_m(one) < 7e-4 and off_m(both) < 7e-4
    errors = one.errors(FAR, np.concatenate([FAR, 0.0 * FAR]))
    said = float(np.sqrt(np.mean(np.sum(errors**2, axis=(0, 3)))))
    assert 0.3 * said < off_m(one) < 3.0 * said


def test_a_marker_that_is_covered_goes_on_as_it_went() -> None:
    hidden = range(11, 14)
    path = marker_path([view_of(CAMERAS[0], np.random.default_rng(2), hidden)], 7, "4X4_50")
    assert not path.seen[hidden].any() and path.seen.sum() == FRAMES - len(hidden)
    assert off_m(path) < 2e-3


def test_a_marker_that_is_not_there_is_refused_with_those_that_are() -> None:
    views = [view_of(CAMERAS[0], np.random.default_rng(3))]
    with pytest.raises(TrackingFailed, match=r"marker 3 of 4X4_50 is seen; seen were \[7\] in 24 frames"):
        sighted(views, 3)
    with pytest.raises(TrackingFailed, match="no dictionary '9X9'"):
        sighted(views, 3, "9X9")
