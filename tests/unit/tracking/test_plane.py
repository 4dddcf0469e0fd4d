"""Planes from markers and boards, and what tells that a motion has left its plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planar_filmed import BOARD, FOCAL, HEIGHT, MARKER_M, WIDTH, Film

from physworld.camera import Camera
from physworld.errors import TrackingFailed
from physworld.tracking.boards import Board, find_board
from physworld.tracking.plane import facing, frontal, stretch, view_of
from physworld.tracking.view import View, back_project
from physworld_workers.commands.importing_planar import board_of

pytestmark = pytest.mark.slow

CAMERA = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, np.eye(4))


def still(shift_px: int = 0, camera: Camera = CAMERA) -> View:
    """The board and the straight strip for four frames; ``shift_px``: of each against the one before."""
    picture = Film().frame(0)
    return View(
        camera,
        lambda frame: np.roll(picture, frame * shift_px, axis=1),
        lambda frame: np.zeros((HEIGHT, WIDTH), np.float32),
        4,
    )


@pytest.mark.parametrize(("text", "most"), [(BOARD, 0.002), (f"marker:13:{MARKER_M}", 0.03)])
def test_a_board_and_a_single_marker_tell_scale_and_tilt(text: str, most: float) -> None:
    seen = find_board(still(), board_of(text), focal_known=True)
    ends = Film().pixel(np.array([[0.06, 0.06], [0.26, 0.18]])) + 0.5
    places = seen.plane.at(CAMERA, ends)
    length = float(np.linalg.norm(places[1] - places[0]))
    assert length == pytest.approx(float(np.hypot(0.2, 0.12)), rel=most)
    assert seen.plane.tilt_deg == pytest.approx(20.0, abs=200 * most)
    assert np.allclose(seen.plane.axes @ seen.plane.axes.T, np.eye(3), atol=1e-12)
    assert seen.frames == (4, 4) and seen.drift_px < 0.01


def test_a_focal_length_that_nobody_knows_is_found_with_a_tilted_board() -> None:
    wrong = replace(CAMERA, fx=1.6 * FOCAL, fy=1.6 * FOCAL)
    found = find_board(still(camera=wrong), board_of(BOARD), focal_known=False)
    assert found.camera.fx == pytest.approx(FOCAL, rel=0.03)
    believed = find_board(still(camera=wrong), board_of(BOARD), focal_known=True)
    assert believed.plane.residual_px > 4.0 * found.plane.residual_px


def test_a_board_that_moves_is_refused_with_how_far() -> None:
    with pytest.raises(TrackingFailed, match=r"moves by up to 6\.\d px"):
        find_board(still(shift_px=4), board_of(BOARD), focal_known=True)


def test_a_board_that_is_declared_twice_as_large_makes_all_twice_as_large() -> None:
    small = find_board(still(), board_of(BOARD), focal_known=True).plane
    large = find_board(still(), Board(7, 5, 0.068, square_m=0.09), focal_known=True).plane
    assert np.allclose(large.origin, 2.0 * small.origin, rtol=1e-3)


def test_depth_of_a_plane_takes_pixels_to_it_and_back() -> None:
    plane = facing(np.array([0.1, -0.05, 0.8]), np.array([0.3, -0.5, -1.0])).nearer(0.05)
    view = view_of(still(), plane, np.eye(3))
    rows, columns = np.mgrid[3:HEIGHT:50, 7:WIDTH:50]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    places = back_project(view.camera, pixels, view.depth(0)[rows.ravel(), columns.ravel()].astype(float))
    assert np.abs(places[:, 2]).max() < 1e-6
    assert np.allclose(view.camera.project(places)[0], pixels, atol=1e-3)
    with pytest.raises(TrackingFailed, match="degrees from its normal"):
        facing(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.01]))


def test_a_length_across_the_axis_has_it() -> None:
    picks = np.array([[100.5, 80.5], [300.5, 120.5]])
    places = frontal(CAMERA, picks, 0.4).at(CAMERA, picks)
    assert np.linalg.norm(places[1] - places[0]) == pytest.approx(0.4)
    before = frontal(CAMERA, picks, 0.4).nearer(0.1)
    there = before.at(CAMERA, picks)
    assert np.linalg.norm(there[1] - there[0]) == pytest.approx(0.4 * (places[0, 2] - 0.1) / places[0, 2])
    turned = frontal(CAMERA, picks, 0.4).turned(places[0], places[1])
    down = (places[1] - places[0]) / 0.4
    assert np.allclose(turned.axes[1], -down) and np.linalg.det(turned.axes) == pytest.approx(1.0)


def test_distances_keep_in_the_plane_and_change_out_of_it() -> None:
    rng = np.random.default_rng(1)
    start = np.concatenate([rng.uniform(-0.1, 0.1, (40, 2)), np.zeros((40, 1))], axis=1)
    turn = np.radians(35)
    within = start @ np.array(
        [[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]]
    )
    nearer = start * 0.5 / 0.45
    tracks = np.stack([start, within, nearer, start])
    visible = np.ones((4, 40), dtype=bool)
    visible[3, 2:] = False
    ratios = stretch(tracks, visible)
    assert np.allclose(ratios[:3], [1.0, 1.0, 0.5 / 0.45]) and np.isnan(ratios[3])
    assert np.isnan(stretch(tracks, np.zeros_like(visible))).all()
