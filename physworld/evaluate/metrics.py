"""Errors of predicted against measured points, per frame [m].

Two Chamfer distances with two names, never mixed (PhysTwin's evaluation, and the paper's appendix):

* ``chamfer_phystwin``: measured visible points to their nearest predicted point, one direction, L1 norm
  ``|dx| + |dy| + |dz|`` (both to find the nearest and to measure it), mean over points, then over frames.
* ``chamfer_l2``: both directions, Euclidean, the two means added, mean over frames.

``track_error`` is the mean Euclidean distance of predicted to measured material points where they were seen.
A frame in which nothing was seen has no error: it is NaN per frame and left out of every mean. PhysTwin's
published code counts such a frame as 0; ``track_error_phystwin`` is that variant, to be reported beside.

:func:`metrics` lists them all: tables, comparisons, dashboard and command line show what it has. A new one is a
function and an entry in this file, or an entry point of another package (:mod:`physworld.catalogue`).

Legend: T frames, N measured points, M predicted points (M = N for tracks).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.catalogue import with_plugins

L1 = 1
L2 = 2

MEAN_DISTANCE_PER_SIGMA = float(np.sqrt(8.0 / np.pi))
"""Mean length of a 3-D Gaussian vector of unit deviation per axis (the Maxwell distribution's mean)."""


def track_error_per_frame(predicted: Array, measured: Array, visible: Array) -> Array:
    """Mean Euclidean error over the visible points of each frame [m], shape (T,); NaN where none is visible.

    Args:
        predicted: predicted positions of the measured material points [m], (T, N, 3).
        measured: measured positions [m], (T, N, 3); ignored where not visible.
        visible: (T, N) bool.
    """
    _check_tracks(predicted, measured, visible)
    distance = np.linalg.norm(np.where(visible[..., None], predicted - measured, 0.0), axis=-1)
    count = visible.sum(axis=1)
    return np.where(count > 0, distance.sum(axis=1) / np.maximum(count, 1), np.nan)


def track_error(predicted: Array, measured: Array, visible: Array) -> float:
    """Mean of ``track_error_per_frame`` over the frames with a visible point [m]; NaN when there is none."""
    return mean_over_frames(track_error_per_frame(predicted, measured, visible))


def track_error_phystwin(predicted: Array, measured: Array, visible: Array) -> float:
    """PhysTwin's variant: a frame in which nothing was seen counts as error 0 [m]."""
    return mean_with_hidden_as_zero(track_error_per_frame(predicted, measured, visible))


def chamfer_phystwin_per_frame(predicted: Array, measured: Array, visible: Array) -> Array:
    """One-way L1 Chamfer distance of each frame [m], shape (T,); NaN where nothing is visible.

    Args:
        predicted: predicted surface points [m], (T, M, 3).
        measured: measured points [m], (T, N, 3); ignored where not visible.
        visible: (T, N) bool.
    """
    _check_clouds(predicted, measured, visible)
    error = np.full(len(measured), np.nan)
    for t, seen in enumerate(visible):
        if seen.any():
            error[t] = _mean_nearest(measured[t, seen], predicted[t], L1)
    return error


def chamfer_phystwin(predicted: Array, measured: Array, visible: Array) -> float:
    """Mean of ``chamfer_phystwin_per_frame`` over the frames with a visible point [m]."""
    return mean_over_frames(chamfer_phystwin_per_frame(predicted, measured, visible))


def chamfer_l2_per_frame(predicted: Array, measured: Array, visible: Array) -> Array:
    """Two-way Euclidean Chamfer distance of each frame [m], shape (T,): the sum of both directions' means.

    Takes what ``chamfer_phystwin_per_frame`` takes. Every predicted point counts in the way back, also one
    whose measured neighbour is hidden, so occlusion alone gives a floor above zero.
    """
    _check_clouds(predicted, measured, visible)
    error = np.full(len(measured), np.nan)
    for t, seen in enumerate(visible):
        if seen.any():
            there = _mean_nearest(measured[t, seen], predicted[t], L2)
            error[t] = there + _mean_nearest(predicted[t], measured[t, seen], L2)
    return error


def chamfer_l2(predicted: Array, measured: Array, visible: Array) -> float:
    """Mean of ``chamfer_l2_per_frame`` over the frames with a visible point [m]."""
    return mean_over_frames(chamfer_l2_per_frame(predicted, measured, visible))


def mean_over_frames(per_frame: Array) -> float:
    """Mean of the frames that have a value; NaN when none has one."""
    known = per_frame[~np.isnan(per_frame)]
    return float(known.mean()) if known.size else float("nan")


def mean_with_hidden_as_zero(per_frame: Array) -> float:
    """Mean over all frames, those without a value counted as 0."""
    return float(np.nan_to_num(per_frame, nan=0.0).mean())


def noise_floor(noise_sigma_m: float) -> float:
    """Track error of a perfect prediction under Gaussian tracking noise [m]: sigma sqrt(8/pi)."""
    return noise_sigma_m * MEAN_DISTANCE_PER_SIGMA


@dataclass(frozen=True)
class Metric:
    """How a prediction of measured points is scored.

    Attributes:
        name: key in tables of results; ends with the unit.
        title: a few words for people.
        unit: SI unit, "1" for none.
        help: what is measured.
        per_frame: predicted (T, M, 3) [m], measured (T, N, 3) [m] and visible (T, N) points to a value a frame (T,),
            NaN where there is none. ``held_out_table`` gives predictions of the measured points, so M = N.
        mean: a curve (T,) to one value.
        lower_is_better: whether a smaller value is the better one.
        listed: shown in comparisons, reports and pages, and kept as a curve; others stand in the table of means only.
    """

    name: str
    title: str
    unit: str
    help: str
    per_frame: Callable[[Array, Array, Array], Array]
    mean: Callable[[Array], float] = mean_over_frames
    lower_is_better: bool = True
    listed: bool = True


_BUILT_IN = (
    Metric(
        "track_m",
        "Track",
        "m",
        "mean Euclidean distance of predicted to measured points where these are visible; mean over frames",
        track_error_per_frame,
    ),
    Metric(
        "chamfer_phystwin_m",
        "Chamfer (PhysTwin)",
        "m",
        "measured visible points to their nearest predicted point, one way, L1 norm; mean over points, then frames",
        chamfer_phystwin_per_frame,
    ),
    Metric(
        "chamfer_l2_m",
        "Chamfer (L2)",
        "m",
        "both ways, Euclidean, the two means added; mean over frames. Every predicted point counts in the way back, "
        "so occlusion alone gives a floor",
        chamfer_l2_per_frame,
    ),
    Metric(
        "track_phystwin_m",
        "Track (PhysTwin)",
        "m",
        "as track_m, but a frame in which nothing was seen counts as 0 (PhysTwin's published code)",
        track_error_per_frame,
        mean_with_hidden_as_zero,
        listed=False,
    ),
)


@cache
def metrics() -> dict[str, Metric]:
    """Every metric by name, our own first."""
    return with_plugins("physworld.metrics", Metric, {metric.name: metric for metric in _BUILT_IN})


def _mean_nearest(points: Array, targets: Array, norm: int) -> float:
    """Mean distance of ``points`` to their nearest of ``targets`` in the given Minkowski norm."""
    distance, _ = cKDTree(targets).query(points, p=norm)
    return float(np.mean(distance))


def _check_tracks(predicted: Array, measured: Array, visible: Array) -> None:
    if predicted.shape != measured.shape:
        raise ValueError(f"predicted tracks have shape {predicted.shape}, measured {measured.shape}")
    _check_clouds(predicted, measured, visible)


def _check_clouds(predicted: Array, measured: Array, visible: Array) -> None:
    if measured.ndim != 3 or measured.shape[2] != 3 or visible.shape != measured.shape[:2]:
        raise ValueError(f"measured points have shape {measured.shape}, visible {visible.shape}")
    if predicted.ndim != 3 or predicted.shape[2] != 3 or len(predicted) != len(measured):
        raise ValueError(f"predicted points have shape {predicted.shape}, measured {measured.shape}")
    if predicted.shape[1] == 0:
        raise ValueError("a prediction needs at least one point")
    if not np.isfinite(predicted).all():
        frame = int(np.argmax(~np.isfinite(predicted).all(axis=(1, 2))))
        raise ValueError(f"the prediction is not finite from frame {frame} of {len(predicted)}")
