"""Tracks that another tracker made, put into space by the depth as our own are.

A learned tracker (CoTracker, TAPIR) says where points are in the picture and when they are seen. What is on the object
in the first frame is kept, thinned to what was asked for; neighbours give the turn of each point's surroundings, and
depth and neighbours say where it is in space and whether it is seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.neighbours import picture_motion
from physworld.tracking.places import LEAST_POINTS, FirstPlaces, Places, TrackConfig, Tracks
from physworld.tracking.view import View


@dataclass(frozen=True)
class GivenTracks:
    """One camera's.

    Attributes:
        pixels: (T, N, 2) in the convention of :mod:`physworld.camera`; finite and in the picture where visible.
        visible: (T, N) bool.
    """

    pixels: Array
    visible: Array


def follow_given(
    view: View,
    mask: Array,
    given: GivenTracks,
    config: TrackConfig | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Tracks:
    """The tracks in space.

    Args:
        view: the recording.
        mask: the object in the first frame, (H, W) bool.
        given: of as many frames.
        config: how many points at most, and how their places are found.
        progress: told frames done and frames in all.

    Raises:
        TrackingFailed: too few of them begin on the object, with depth.
    """
    config = config or TrackConfig()
    if len(given.pixels) != view.frames:
        raise TrackingFailed(f"tracks have {len(given.pixels)} frames, the recording {view.frames}")
    depth = view.depth(0)
    chosen = _chosen(given, mask, config.points)
    start = FirstPlaces(view.camera, mask, depth, given.pixels[0, chosen], config.depth_px)
    measured = np.isfinite(start.distance)
    if measured.sum() < LEAST_POINTS:
        raise TrackingFailed(
            f"{int(measured.sum())} tracks can be used, {LEAST_POINTS} are needed: of {given.visible.shape[1]} tracks "
            f"{int(given.visible[0].sum())} are seen in the first frame, {len(chosen)} of them on the object's "
            f"{int(mask.sum())} pixels and apart, {int(measured.sum())} with depth"
        )
    kept = chosen[measured]
    places = Places(start, measured, config)
    colours = view.colour(0)
    row, column = (given.pixels[0, kept, axis].astype(int) for axis in (1, 0))
    points = np.empty((view.frames, len(kept), 3))
    visible = np.zeros((view.frames, len(kept)), dtype=bool)
    pixels = np.empty((view.frames, len(kept), 2))
    points[0], visible[0], pixels[0] = places.first, True, given.pixels[0, kept]
    for frame in range(1, view.frames):
        seen = given.visible[frame, kept]
        now = np.where(seen[:, None], given.pixels[frame, kept], 0.0)
        there, maps, _ = picture_motion(pixels[0], now, seen, places.neighbours)
        pixels[frame] = np.where(seen[:, None], now, there)
        points[frame], visible[frame] = places.at(view.depth(frame), pixels[frame], maps, seen)
        progress(frame + 1, view.frames)
    return Tracks(points, visible, pixels, colours[row, column])


def _chosen(given: GivenTracks, mask: Array, count: int) -> Array:
    """Numbers of tracks that begin on the object and are apart, those that are seen longest first; about ``count``."""
    height, width = mask.shape
    at = np.floor(np.where(given.visible[0][:, None], given.pixels[0], -1.0)).astype(int)
    shown = ((at >= 0) & (at < [width, height])).all(axis=1)
    on = np.zeros(len(at), dtype=bool)
    on[shown] = mask[at[shown, 1], at[shown, 0]]
    order = np.flatnonzero(on)[np.argsort(-given.visible[:, on].sum(axis=0), kind="stable")]
    apart = max(1.0, 0.75 * float(np.sqrt(mask.sum() / count)))
    kept: list[int] = []
    places = given.pixels[0]
    for number in order:
        if len(kept) >= count:
            break
        if not kept or np.linalg.norm(places[kept] - places[number], axis=1).min() >= apart:
            kept.append(int(number))
    return np.array(kept, dtype=int)
