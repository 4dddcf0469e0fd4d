"""Tracks that another tracker made, put into space by the depth as our own are.

A learned tracker (CoTracker, TAPIR) says where points are in the picture and when they are seen. What is on the object
in the first frame is kept, thinned to what was asked for; neighbours give the turn of each point's surroundings, and
depth and neighbours say where it is in space and whether it is seen.
"""

from __future__ import annotations

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


class GivenFollower:
    """Puts the tracks into space from frame to frame, as :class:`physworld.tracking.points.Follower` does its own.

    Args:
        view: the recording.
        mask: the object in the first frame, (H, W) bool.
        given: of as many frames.
        config: how many points at most, and how their places are found.

    Attributes:
        first: places in the first frame [m], (n, 3).
        points, visible: places [m] and whether they are seen, of the frames so far, (T, n, 3) and (T, n).

    Raises:
        TrackingFailed: too few of them begin on the object, with depth.
    """

    def __init__(self, view: View, mask: Array, given: GivenTracks, config: TrackConfig) -> None:
        if len(given.pixels) != view.frames:
            raise TrackingFailed(f"tracks have {len(given.pixels)} frames, the recording {view.frames}")
        chosen = _chosen(given, mask, config.points)
        start = FirstPlaces(view.camera, mask, view.depth(0), given.pixels[0, chosen], config.depth_px)
        measured = np.isfinite(start.distance)
        if measured.sum() < LEAST_POINTS:
            raise TrackingFailed(
                f"{int(measured.sum())} tracks can be used, {LEAST_POINTS} are needed: of {given.visible.shape[1]} "
                f"tracks {int(given.visible[0].sum())} are seen in the first frame, {len(chosen)} of them on the "
                f"object's {int(mask.sum())} pixels and apart, {int(measured.sum())} with depth"
            )
        kept = chosen[measured]
        self._view, self._places = view, Places(start, measured, config)
        self._given, self._seen = given.pixels[:, kept], given.visible[:, kept]
        self.first = self._places.first
        self.points = np.full((view.frames, len(kept), 3), np.nan)
        self.visible = np.zeros((view.frames, len(kept)), dtype=bool)
        self._pixels = np.full((view.frames, len(kept), 2), np.nan)
        self.points[0], self.visible[0], self._pixels[0] = self.first, True, self._given[0]

    def step(self, frame: int, told: Array | None = None) -> None:
        """The next frame.

        Args:
            frame: its number.
            told: where other cameras put the points; the tracks are given, and it is not used.
        """
        seen = self._seen[frame]
        now = np.where(seen[:, None], self._given[frame], 0.0)
        there, maps, _ = picture_motion(self._pixels[0], now, seen, self._places.neighbours)
        self._pixels[frame] = np.where(seen[:, None], now, there)
        depth = self._view.depth(frame)
        self.points[frame], self.visible[frame] = self._places.at(depth, self._pixels[frame], maps, seen)

    def tracks(self) -> Tracks:
        """What was found."""
        colour = self._view.colour(0)
        row, column = (self._given[0, :, axis].astype(int) for axis in (1, 0))
        return Tracks(self.points, self.visible, self._pixels, colour[row, column])


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
