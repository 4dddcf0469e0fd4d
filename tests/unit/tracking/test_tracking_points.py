"""Points on a plate whose motion is known: error, occlusion, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from tracking_pictured import BOTTOM, COVERED, LEFT, RIGHT, TOP, affine, frame_of, view

from physworld.errors import TrackingFailed
from physworld.tracking.grips import logged
from physworld.tracking.mask import mask_in_box
from physworld.tracking.places import TrackConfig
from physworld.tracking.points import follow
from physworld.tracking.rigid import kabsch, rigid_path
from physworld.tracking.view import Box

pytestmark = pytest.mark.slow

CONFIG = TrackConfig(points=40, patch_px=7, depth_px=3)
MEDIAN_PX, MOST_PX = 0.1, 0.6  # bilinear patches of a picture that was itself interpolated


def plate_mask() -> np.ndarray:
    mask = np.zeros((120, 160), dtype=bool)
    mask[TOP:BOTTOM, LEFT:RIGHT] = True
    return mask


def exact(start: np.ndarray, frame: int) -> np.ndarray:
    matrix = affine(frame)
    return (start - 0.5) @ matrix[:, :2].T + matrix[:, 2] + 0.5


def test_points_turn_and_move_with_the_plate_and_do_not_drift() -> None:
    tracks = follow(view(), plate_mask(), CONFIG)
    assert tracks.visible.shape[1] >= 20
    for frame in (1, 6, 11):
        seen = tracks.visible[frame]
        miss = np.linalg.norm(tracks.pixels[frame] - exact(tracks.pixels[0], frame), axis=1)[seen]
        assert seen.mean() > 0.8
        assert np.median(miss) < MEDIAN_PX and miss.max() < MOST_PX
    assert np.allclose(tracks.points[tracks.visible][:, 2], 0.5, atol=1e-3)


def test_covered_points_are_not_seen_and_come_back() -> None:
    tracks = follow(view(cover=True), plate_mask(), CONFIG)
    covered = [exact(tracks.pixels[0], frame)[:, 0] < 74 for frame in COVERED]
    for frame, behind in zip(COVERED, covered, strict=True):
        assert behind.sum() >= 5
        assert not tracks.visible[frame, behind].any()
    behind = covered[-1]
    assert tracks.visible[9, behind].mean() > 0.7
    miss = np.linalg.norm(tracks.pixels[9] - exact(tracks.pixels[0], 9), axis=1)
    assert miss[behind & tracks.visible[9]].max() < MOST_PX


def test_the_mask_is_what_stands_out_in_the_box() -> None:
    colour, depth = frame_of(0)
    from tracking_pictured import CAMERA

    mask = mask_in_box(colour, depth, CAMERA, Box(LEFT - 8, TOP - 8, RIGHT + 8, BOTTOM + 8))
    both = (mask & plate_mask()).sum() / (mask | plate_mask()).sum()
    assert both > 0.95


def test_a_box_without_the_object_is_refused_with_numbers() -> None:
    colour, depth = frame_of(0)
    from tracking_pictured import CAMERA

    with pytest.raises(TrackingFailed, match="0 pixels of the box have depth"):
        mask_in_box(colour, np.zeros_like(depth), CAMERA, Box(LEFT, TOP, RIGHT, BOTTOM))
    with pytest.raises(TrackingFailed, match="nothing of the picture"):
        mask_in_box(colour, depth, CAMERA, Box(500, 500, 600, 600))


def test_a_surface_without_texture_is_refused() -> None:
    plain = np.full((120, 160, 3), 90, np.uint8)
    depth = frame_of(0)[1]
    bare = view()
    bare = type(bare)(bare.camera, lambda t: plain, lambda t: depth, 3)
    with pytest.raises(TrackingFailed, match="0 points of the object can be followed"):
        follow(bare, plate_mask(), CONFIG)


def test_a_rigid_path_is_found_through_noise_and_gaps() -> None:
    rng = np.random.default_rng(1)
    shape = rng.normal(scale=0.03, size=(4, 3))
    angles = np.linspace(0.0, 0.8, 30)
    turns = np.stack([[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in angles])
    exact_path = np.einsum("tij,kj->tki", turns, shape) + np.linspace(0, 0.2, 30)[:, None, None]
    measured = exact_path + rng.normal(scale=1e-4, size=exact_path.shape)
    measured[10:13] = np.nan
    path = rigid_path(measured)
    assert path.seen.sum() == 27
    assert np.abs(path.carry(shape) - exact_path).max() < 5e-4
    assert path.misfit_m == pytest.approx(1e-4, rel=0.4)


def test_kabsch_gives_rotations_never_mirrors() -> None:
    points = np.random.default_rng(0).normal(size=(5, 3))
    turn, _ = kabsch(points, points * [1, 1, -1])
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_a_log_that_ends_early_is_refused() -> None:
    with pytest.raises(
        TrackingFailed, match=r"runs from 0\.000 to 0\.500 s, the recording from 0\.000 to 1\.000 s"
    ):
        logged(np.array([0.0, 0.5]), np.zeros((2, 3)), None, np.array([0.0, 1.0]))
