"""Material points followed through one camera's pictures.

In every frame: Lucas-Kanade from the last frame with a check backwards (OpenCV); what neighbours make of it, which
is the guess for lost points too and turns the patches; the patch of the first frame found again at that place,
coarse and fine; depth at it; and at last whether the point goes with the material around it. A point that fails is
not seen in this frame and is sought again in the next, so that it comes back when what covered it has gone; where
few are left, features of the first frame are sought in the whole picture. Places come from the first
frame's patch alone: nothing adds up from frame to frame.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.anywhere import Features
from physworld.tracking.neighbours import picture_motion
from physworld.tracking.patches import Patches, cut, find
from physworld.tracking.places import LEAST_POINTS, FirstPlaces, Places, TrackConfig, Tracks
from physworld.tracking.view import View, from_opencv, to_opencv


def choose(grey: Array, mask: Array, depth: Array, count: int) -> Array:
    """Pixels (N, 2) of the mask with something to follow and with depth, spread over it; N is about ``count`` at most.

    Args:
        grey: (H, W) uint8.
        mask: (H, W) bool.
        depth: (H, W) [m], 0: none.
        count: wanted.
    """
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
    spacing = max(2.0, 0.75 * float(np.sqrt(mask.sum() / count)))
    corners = cv2.goodFeaturesToTrack(grey, 2 * count, 0.005, spacing, mask=inner, blockSize=5)
    if corners is None:
        return np.zeros((0, 2))
    pixels = from_opencv(corners[:, 0])
    row, column = pixels[:, 1].astype(int), pixels[:, 0].astype(int)
    kept: Array = pixels[depth[row, column] > 0][:count]
    return kept


def follow(
    view: View,
    mask: Array,
    config: TrackConfig | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Tracks:
    """Tracks of points on the object through all frames of one camera.

    Args:
        view: the recording.
        mask: the object in the first frame, (H, W) bool.
        config: how.
        progress: told frames done and frames in all.

    Raises:
        TrackingFailed: too few points can be followed, or pictures differ in size.
    """
    config = config or TrackConfig()
    follower = Follower(view, mask, config)
    for frame in range(1, view.frames):
        follower.step(frame)
        progress(frame + 1, view.frames)
    return follower.tracks()


class Follower:
    """Follows points from frame to frame.

    Args:
        view: the recording.
        mask: the object in the first frame, (H, W) bool.
        config: how.

    Attributes:
        first: places in the first frame [m], (n, 3).
        points, visible: places [m] and whether they are seen, of the frames so far, (T, n, 3) and (T, n).
    """

    def __init__(self, view: View, mask: Array, config: TrackConfig) -> None:
        self._view, self._config = view, config
        colour, depth = view.colour(0), view.depth(0)
        self._shape = depth.shape
        if colour.shape != (*depth.shape, 3) or mask.shape != depth.shape:
            raise TrackingFailed(
                f"colours {colour.shape}, depth {depth.shape} and mask {mask.shape} differ in size"
            )
        grey = cv2.cvtColor(np.ascontiguousarray(colour), cv2.COLOR_RGB2GRAY)
        pixels = choose(grey, mask, depth, config.points)
        if len(pixels) < LEAST_POINTS:
            raise TrackingFailed(
                f"{len(pixels)} points of the object can be followed, {LEAST_POINTS} are needed: "
                f"its {int(mask.sum())} pixels have no texture, or no depth where they have"
            )
        fine = cut(grey.astype(np.float32), mask, pixels, config.patch_px)
        coarse = cut(grey.astype(np.float32), mask, pixels, config.patch_px + 3, 2.0)
        first = FirstPlaces(view.camera, mask, depth, pixels, config.depth_px)
        distance = first.distance
        kept = fine.usable & np.isfinite(distance)
        if kept.sum() < LEAST_POINTS:
            raise TrackingFailed(
                f"{int(kept.sum())} points of the object can be followed, {LEAST_POINTS} are needed: "
                f"{len(pixels)} corners, {int(fine.usable.sum())} with contrast, "
                f"{int(np.isfinite(distance).sum())} with depth"
            )
        self._fine, self._coarse = _kept(fine, kept), _kept(coarse, kept)
        self._start = pixels[kept]
        self._places = Places(first, kept, config)
        self.first, self._neighbours = self._places.first, self._places.neighbours
        count, frames = int(kept.sum()), view.frames
        self.points = np.full((frames, count, 3), np.nan)
        self._pixels = np.full((frames, count, 2), np.nan)
        self.visible = np.zeros((frames, count), dtype=bool)
        self.points[0], self._pixels[0], self.visible[0] = self.first, self._start, True
        row, column = self._start[:, 1].astype(int), self._start[:, 0].astype(int)
        self._colours = colour[row, column]
        self._before = grey
        self._last_maps = np.tile(np.eye(2), (count, 1, 1))
        self._features = Features(grey, self._start)

    def step(self, frame: int, told: Array | None = None) -> None:
        """The next frame.

        Args:
            frame: its number.
            told: where other cameras put the points now [m], (n, 3), or None.
        """
        config = self._config
        colour, depth = self._view.colour(frame), self._view.depth(frame)
        if colour.shape[:2] != self._shape or depth.shape != self._shape:
            raise TrackingFailed(
                f"frame {frame}: colours {colour.shape[:2]} and depth {depth.shape} are not {self._shape}"
            )
        grey = cv2.cvtColor(np.ascontiguousarray(colour), cv2.COLOR_RGB2GRAY)
        guess, maps = self._guess(grey, frame, told)
        picture = grey.astype(np.float32)
        near, rough = find(picture, self._coarse, guess, maps, 2.0)
        onward = self._onward(frame)
        also, better = find(picture, self._coarse, onward, self._last_maps, 2.0)
        better = np.where(_apart(also, onward, 12.0), better, -1.0)
        swapped = (better > rough + 0.02) | ((better > rough) & ~_apart(near, guess, 12.0))
        near = np.where(swapped[:, None], also, near)
        rough, guess = np.where(swapped, better, rough), np.where(swapped[:, None], also, guess)
        near = np.where(((rough > 0.6) & _apart(near, guess, 12.0))[:, None], near, guess)
        places, correlation = find(picture, self._fine, near, maps)
        area = np.abs(np.linalg.det(maps))
        seen = (
            (correlation >= config.least_correlation) & _apart(places, near, 4.0) & (area > config.least_area)
        )
        # the places found turn the patches better than the flow did
        again, maps = self._surroundings(places, seen, guess)
        refined, correlation = find(picture, self._fine, np.where(seen[:, None], places, again), maps)
        seen = (
            (correlation >= config.least_correlation)
            & (_apart(refined, places, 2.0) | ~seen)
            & _apart(refined, again, 6.0)
            & (np.abs(np.linalg.det(maps)) > config.least_area)
        )
        self.points[frame], self.visible[frame] = self._places.at(depth, refined, maps, seen)
        self._pixels[frame] = np.where(self.visible[frame][:, None], refined, again)
        self._before, self._last_maps = grey, maps

    def _guess(self, grey: Array, frame: int, told: Array | None) -> tuple[Array, Array]:
        """Where points should be by the flow from the last frame and by their neighbours; the maps of their patches."""
        last = self._pixels[frame - 1]
        known = self.visible[frame - 1]
        if told is not None and known.mean() < self._config.told_below:
            hinted, distance = self._view.camera.project(told)
            return self._surroundings(np.where(distance[:, None] > 0, hinted, last), distance > 0, last)
        if known.mean() < self._config.rediscover_below:
            return self._rediscovered(grey, frame)
        there = to_opencv(last)
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
        side = (2 * self._config.patch_px + 1,) * 2
        now, status, _ = cv2.calcOpticalFlowPyrLK(
            self._before, grey, there, None, winSize=side, maxLevel=3, criteria=criteria
        )
        back, returned, _ = cv2.calcOpticalFlowPyrLK(
            grey, self._before, now, None, winSize=side, maxLevel=3, criteria=criteria
        )
        flow = from_opencv(now)
        sure = known & (status[:, 0] > 0) & (returned[:, 0] > 0)
        sure &= _apart(back, there, self._config.backward_px)
        places, maps = self._surroundings(flow, sure, last)
        return np.where(sure[:, None], flow, places), maps

    def _onward(self, frame: int) -> Array:
        """Places (N, 2) if points go on as they went: thin things before a still background carry the flow off."""
        last: Array = self._pixels[frame - 1]
        if frame >= 2:
            last = last + np.clip(last - self._pixels[frame - 2], -60.0, 60.0)
        return last

    def _rediscovered(self, grey: Array, frame: int) -> tuple[Array, Array]:
        """The same from features of the first frame that are found anywhere in the picture."""
        last, known = self._pixels[frame - 1], self.visible[frame - 1]
        found, sure = self._features.find(grey)
        places = np.where(sure[:, None], found, last)
        return self._surroundings(places, sure | known, last)

    def _surroundings(self, places: Array, sure: Array, otherwise: Array) -> tuple[Array, Array]:
        """Where neighbours put points, and how their patches are turned; of a point without any, what all points
        say."""
        if sure.sum() < LEAST_POINTS:
            return otherwise.copy(), self._last_maps
        there, maps, count = picture_motion(self._start, places, sure, self._neighbours)
        alone = count < 2
        if alone.any():
            everyone = np.tile(np.flatnonzero(sure), (len(places), 1))
            whole, turned, _ = picture_motion(self._start, places, sure, everyone)
            there[alone], maps[alone] = whole[alone], turned[alone]
        return there, maps

    def tracks(self) -> Tracks:
        """What was found."""
        return Tracks(self.points, self.visible, self._pixels, self._colours)


def _apart(one: Array, other: Array, most: float) -> Array:
    """Whether places (N, 2) are not farther apart than ``most`` [px], (N,) bool."""
    near: Array = np.linalg.norm(one - other, axis=1) <= most
    return near


def _kept(patches: Patches, kept: Array) -> Patches:
    return Patches(
        patches.offsets,
        patches.weights[kept],
        patches.values[kept],
        patches.slopes[kept],
        patches.usable[kept],
    )
