"""The plane that the object stands on or hangs above, and the world that it gives: z up, the plane at z = 0.

RANSAC (Fischler & Bolles 1981) over the depth pixels outside of the object; the plane must look up in the picture,
since walls are planes too. The error of depth grows with its square, and so does the distance at which a pixel
counts as in the plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera

TRIES = 400
SAMPLED = 4000
INLIER_SHARE = 8e-3
"""Of the squared distance [1/m]: 5 mm at 0.8 m."""
LEAST_SHARE = 0.15
"""Of the pixels with depth that a ground has."""


@dataclass(frozen=True)
class Plane:
    """normal · x = height in the frame of the points it was fitted to; the normal (3,) points to the camera's side [m].

    Attributes:
        normal: (3,), of length 1.
        height: [m].
        share: of the points that lie in it.
        spread_m: deviation of these from it.
    """

    normal: Array
    height: float
    share: float
    spread_m: float


def ground_plane(points: Array, up: Array, eye: Array, steepest_deg: float = 60.0) -> Plane | None:
    """The largest plane that looks up, or None.

    Args:
        points: places of pixels outside of the object [m], (P, 3).
        up: about which direction is up, (3,); in a camera's frame -y.
        eye: the camera's place [m], (3,), or of every point the place of the camera that saw it, (P, 3).
        steepest_deg: how far its normal may be from ``up``.
    """
    if len(points) < 100:
        return None
    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(points))[:SAMPLED]
    eyes = np.broadcast_to(eye, points.shape)[chosen]
    points, eye = points[chosen], eyes.mean(axis=0)
    bound = INLIER_SHARE * ((points - eyes) ** 2).sum(axis=1)
    corners = points[rng.integers(0, len(points), (TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(length, 1e-12)[:, None]
    heights = np.einsum("ti,ti->t", normals, corners[:, 0])
    toward = np.sign(normals @ eye - heights)
    normals, heights = normals * toward[:, None], heights * toward
    steep = normals @ (up / np.linalg.norm(up)) < np.cos(np.radians(steepest_deg))
    counts = (np.abs(points @ normals.T - heights) < bound[:, None]).sum(axis=0)
    counts[steep | (length < 1e-9)] = 0
    best = int(np.argmax(counts))
    if counts[best] < LEAST_SHARE * len(points):
        return None
    normal, height = normals[best], heights[best]
    for _ in range(4):
        kept = np.abs(points @ normal - height) < bound
        weights = 1.0 / bound[kept] ** 2
        middle = np.average(points[kept], axis=0, weights=weights)
        centred = (points[kept] - middle) * np.sqrt(weights)[:, None]
        last = np.linalg.svd(centred, full_matrices=False)[2][2]
        normal = last * np.sign(last @ (eye - middle))
        height = float(normal @ middle)
    kept = np.abs(points @ normal - height) < bound
    spread = float(np.std(points[kept] @ normal - height))
    return Plane(normal, height, float(kept.mean()), spread)


def world_over(plane: Plane, camera: Camera) -> Array:
    """``world_to_camera`` (4, 4) of a world whose ground is z = 0, whose origin lies below the camera, x to its right.

    Args:
        plane: in the camera's own frame.
        camera: whose frame that is.
    """
    right = np.array([1.0, 0.0, 0.0])
    x = right - (right @ plane.normal) * plane.normal
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(plane.normal, x), plane.normal], axis=1)
    pose[:3, 3] = plane.height * plane.normal
    answer: Array = camera.world_to_camera @ pose
    return answer
