"""The errors by hand-computed values and by brute force."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.evaluate import metrics

ROUNDING = 1e-12  # sums of a few hundred doubles of order one


def test_track_error_of_a_3_4_5_triangle_is_5() -> None:
    measured = np.zeros((2, 2, 3))
    predicted = measured + np.array([3.0, 4.0, 0.0])
    assert metrics.track_error(predicted, measured, np.ones((2, 2), bool)) == pytest.approx(5.0)


def test_hidden_points_do_not_count_whatever_they_hold() -> None:
    measured = np.zeros((1, 3, 3))
    measured[0, 2] = np.nan
    predicted = np.zeros((1, 3, 3))
    predicted[0, 1] = [0.0, 2.0, 0.0]
    visible = np.array([[True, True, False]])
    assert metrics.track_error(predicted, measured, visible) == pytest.approx(1.0)


def test_a_frame_without_annotation_is_left_out_or_counted_zero_by_name() -> None:
    measured = np.zeros((4, 1, 3))
    predicted = np.full((4, 1, 3), 0.0)
    predicted[..., 0] = 0.02
    visible = np.array([[True], [False], [True], [False]])
    assert metrics.track_error(predicted, measured, visible) == pytest.approx(0.02)
    assert metrics.track_error_phystwin(predicted, measured, visible) == pytest.approx(0.01)
    assert np.isnan(metrics.track_error_per_frame(predicted, measured, visible)).tolist() == [
        False,
        True,
        False,
        True,
    ]


def test_frames_weigh_the_same_whatever_they_show() -> None:
    measured = np.zeros((2, 2, 3))
    predicted = np.zeros((2, 2, 3))
    predicted[1] = [1.0, 0.0, 0.0]
    visible = np.array([[True, True], [True, False]])
    assert metrics.track_error(predicted, measured, visible) == pytest.approx(0.5)


def test_chamfer_phystwin_is_one_way_and_in_the_l1_norm() -> None:
    measured = np.array([[[0.0, 0.0, 0.0]]])
    predicted = np.array([[[1.0, 1.0, 1.0], [0.0, 2.5, 0.0], [50.0, 0.0, 0.0]]])
    seen = np.ones((1, 1), bool)
    # L1 distances 3, 2.5 and 50; in the Euclidean norm the first (1.73) would be the nearest.
    assert metrics.chamfer_phystwin(predicted, measured, seen) == pytest.approx(2.5)


def test_chamfer_l2_adds_both_directions() -> None:
    measured = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    predicted = np.array([[[0.0, 3.0, 4.0]]])
    seen = np.ones((1, 2), bool)
    there = (5.0 + np.sqrt(26.0)) / 2.0
    assert metrics.chamfer_l2(predicted, measured, seen) == pytest.approx(there + 5.0)


def test_chamfer_distances_agree_with_brute_force() -> None:
    rng = np.random.default_rng(3)
    measured, predicted = rng.normal(size=(5, 17, 3)), rng.normal(size=(5, 23, 3))
    visible = rng.random((5, 17)) < 0.7
    one_way, two_way = [], []
    for t in range(5):
        x, y = measured[t][visible[t]], predicted[t]
        difference = x[:, None] - y[None]
        one_way.append(np.abs(difference).sum(-1).min(1).mean())
        length = np.linalg.norm(difference, axis=-1)
        two_way.append(length.min(1).mean() + length.min(0).mean())
    assert metrics.chamfer_phystwin(predicted, measured, visible) == pytest.approx(
        np.mean(one_way), abs=ROUNDING
    )
    assert metrics.chamfer_l2(predicted, measured, visible) == pytest.approx(np.mean(two_way), abs=ROUNDING)


def test_nothing_visible_gives_no_figure() -> None:
    nothing = np.zeros((2, 3), bool)
    assert np.isnan(metrics.track_error(np.zeros((2, 3, 3)), np.zeros((2, 3, 3)), nothing))
    assert np.isnan(metrics.chamfer_phystwin(np.zeros((2, 3, 3)), np.zeros((2, 3, 3)), nothing))
    assert np.isnan(metrics.chamfer_l2(np.zeros((2, 3, 3)), np.zeros((2, 3, 3)), nothing))


def test_noise_floor_is_the_mean_length_of_the_noise() -> None:
    sigma = 1e-3
    noise = np.random.default_rng(0).normal(0.0, sigma, (200, 1000, 3))
    error = metrics.track_error(np.zeros_like(noise), noise, np.ones(noise.shape[:2], bool))
    sampling = 5 * 0.673 * sigma / np.sqrt(noise.shape[0] * noise.shape[1])  # 5 deviations of a Maxwell mean
    assert error == pytest.approx(metrics.noise_floor(sigma), abs=sampling)


def test_shapes_that_disagree_are_refused_with_their_numbers() -> None:
    with pytest.raises(ValueError, match=r"\(2, 4, 3\).*\(2, 3, 3\)"):
        metrics.track_error(np.zeros((2, 4, 3)), np.zeros((2, 3, 3)), np.ones((2, 3), bool))
    with pytest.raises(ValueError, match=r"\(3, 4, 3\).*\(2, 3, 3\)"):
        metrics.chamfer_l2(np.zeros((3, 4, 3)), np.zeros((2, 3, 3)), np.ones((2, 3), bool))


def test_a_prediction_that_blew_up_is_refused_with_its_frame() -> None:
    predicted = np.zeros((4, 2, 3))
    predicted[2:] = np.nan
    with pytest.raises(ValueError, match="frame 2 of 4"):
        metrics.track_error(predicted, np.zeros((4, 2, 3)), np.ones((4, 2), bool))
