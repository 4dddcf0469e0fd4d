"""Points of the first frame sought in the whole picture, for when nothing is left to go on from.

SIFT (Lowe 2004; OpenCV) describes the surroundings of every point in the first frame and every feature of a later
one; a point is found where its best match is clearly better than the second and the match holds the other way round.
"""

from __future__ import annotations

import cv2
import numpy as np

from physworld.arrays import Array
from physworld.tracking.view import from_opencv, to_opencv

RATIO = 0.8
SIZE_PX = 12.0
"""Diameter of what is described."""


class Features:
    """Descriptions of points (N, 2) [px] in the first picture (H, W) uint8."""

    def __init__(self, grey: Array, pixels: Array) -> None:
        self._sift = cv2.SIFT_create()
        self._count = len(pixels)
        keys = [
            cv2.KeyPoint(float(x), float(y), SIZE_PX, -1.0, 0.0, 0, number)
            for number, (x, y) in enumerate(to_opencv(pixels))
        ]
        kept, self._described = self._sift.compute(grey, keys)
        self._owners = np.array([key.class_id for key in kept], dtype=int)

    def find(self, grey: Array) -> tuple[Array, Array]:
        """Places (N, 2) in another picture, and which of them are found, (N,) bool."""
        places, found = np.zeros((self._count, 2)), np.zeros(self._count, dtype=bool)
        keys, described = self._sift.detectAndCompute(grey, None)
        if described is None or self._described is None or len(keys) < 2 or len(self._owners) < 2:
            return places, found
        matcher = cv2.BFMatcher(cv2.NORM_L2)
        there = matcher.knnMatch(self._described, described, k=2)
        back = {match.queryIdx: match.trainIdx for match in matcher.match(described, self._described)}
        for first, second in there:
            if first.distance < RATIO * second.distance and back.get(first.trainIdx) == first.queryIdx:
                owner = self._owners[first.queryIdx]
                places[owner] = from_opencv(np.array(keys[first.trainIdx].pt))
                found[owner] = True
        return places, found
