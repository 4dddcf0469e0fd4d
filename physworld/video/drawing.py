"""A motion as pictures: the splat that its points carry, or, where there is none, a sphere at every point.

The one way from a motion to frames, for the command line and for the service; ``whole_motion_view`` is the camera where
none is given.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera, orbit_view
from physworld.video.gaussians import Gaussians, gaussians_at_points
from physworld.video.moving import GaussianCarrier
from physworld.video.render import Picture, Renderer

MOST_DRAWN = 3000
"""Points of a motion that are drawn where there is no splat."""


def checked_motion(moved: Array, name: str = "the motion") -> Array:
    """Points (T, n, 3) [m] of a motion that can be drawn, in double precision.

    Args:
        moved: the points.
        name: of the motion, for the message.

    Raises:
        ValueError: another shape, a single frame or point, or places that are not finite.
    """
    moved = np.asarray(moved, dtype=np.float64)
    if moved.ndim != 3 or moved.shape[2] != 3 or min(moved.shape[:2]) < 2:
        raise ValueError(f"{name} must be of shape (T, n, 3) with T and n from 2 on, got {moved.shape}")
    if not np.isfinite(moved).all():
        raise ValueError(f"{name} holds {np.sum(~np.isfinite(moved))} numbers that are not finite")
    return moved


def whole_motion_view(
    moved: Array, azimuth_deg: float, elevation_deg: float, width: int, height: int
) -> Camera:
    """A camera that holds every frame of a motion in view.

    Args:
        moved: points (T, n, 3) [m].
        azimuth_deg: of the camera around the vertical, from the x axis [deg].
        elevation_deg: above the ground [deg].
        width: of the picture [px].
        height: likewise.
    """
    return orbit_view(moved.reshape(-1, 3), azimuth_deg, elevation_deg, width, height)


class Drawing:
    """The splat of a motion, and its frames.

    Args:
        moved: points (T, n, 3) [m] that carry the splat.
        rest: the same in the state that the splat shows (n, 3) [m].
        camera: where from.
        splat: of the object; None draws at most ``MOST_DRAWN`` of the points.
        device: Warp device.

    Attributes:
        gaussians: how many are drawn.

    Raises:
        ValueError: a splat so far from the points that it cannot be theirs.
    """

    def __init__(
        self,
        moved: Array,
        rest: Array,
        camera: Camera,
        splat: Gaussians | None = None,
        device: str | None = None,
    ) -> None:
        if splat is None:
            splat = gaussians_at_points(rest[:: max(1, -(-len(rest) // MOST_DRAWN))])
        self.gaussians = len(splat)
        self._moved = moved
        self._carrier, self._renderer = GaussianCarrier(splat, rest), Renderer(camera, device=device)

    def frames(self) -> Iterator[Picture]:
        """The pictures in their order, each made when it is asked for."""
        for points in self._moved:
            yield self._renderer.render(*self._carrier.at(points))


def eight_bit(picture: Picture) -> Array:
    """The colours of a picture as a film holds them, (H, W, 3) uint8."""
    return np.round(picture.rgb * 255.0).astype(np.uint8)
