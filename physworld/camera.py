"""Pinhole cameras in the convention of OpenCV: x right, y down, z forward; pixel centres at half-integers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array

MOST_PIXELS = 4096 * 4096
USUAL_FOCAL = 1.1
"""Focal length of cameras in use, in longer sides of the picture."""


@dataclass(frozen=True)
class Camera:
    """See the module's text.

    Attributes:
        width, height: of the picture [px].
        fx, fy: focal lengths [px].
        cx, cy: principal point [px].
        world_to_camera: (4, 4) rigid transform [m].

    Raises:
        ValueError: a size or focal length that is not positive, or a transform that is not rigid.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Array

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1 or self.width * self.height > MOST_PIXELS:
            raise ValueError(
                f"a picture of {self.width} x {self.height} px; 1 to {MOST_PIXELS} pixels in all"
            )
        if not (self.fx > 0 and self.fy > 0 and np.isfinite([self.fx, self.fy, self.cx, self.cy]).all()):
            raise ValueError(
                f"focal lengths must be positive and finite, got {self.fx:.4g} and {self.fy:.4g} px"
            )
        pose = np.asarray(self.world_to_camera, dtype=np.float64)
        turned = pose[:3, :3] @ pose[:3, :3].T if pose.shape == (4, 4) else np.zeros((3, 3))
        if not np.allclose(turned, np.eye(3), atol=1e-4) or np.linalg.det(pose[:3, :3]) < 0:
            raise ValueError(f"world_to_camera must be a rigid transform of shape (4, 4), got {pose.shape}")
        object.__setattr__(self, "world_to_camera", pose)

    @property
    def centre(self) -> Array:
        """Where it stands in the world [m], (3,)."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (P, 2) and depths (P,) [m] of points (P, 3); a depth at or below 0 is behind the camera."""
        seen = points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        depth = seen[:, 2]
        safe = np.where(depth > 0, depth, np.nan)
        return np.stack(
            [self.fx * seen[:, 0] / safe + self.cx, self.fy * seen[:, 1] / safe + self.cy], 1
        ), depth


def look_at(
    eye: Array,
    target: Array,
    width: int = 640,
    height: int = 480,
    field_of_view_deg: float = 45.0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Camera:
    """A camera at ``eye`` that looks at ``target`` [m]; the field of view is the vertical one.

    Args:
        eye, target: places in the world [m], (3,).
        width, height: of the picture [px].
        field_of_view_deg: vertical [deg].
        up: direction in the world that is up in the picture, (3,).

    Raises:
        ValueError: the eye is at the target, or the view goes along ``up``.
    """
    forward = np.asarray(target, dtype=np.float64) - np.asarray(eye, dtype=np.float64)
    distance = np.linalg.norm(forward)
    right = np.cross(forward, up)
    if not distance > 0 or np.linalg.norm(right) < 1e-9 * distance:
        raise ValueError(f"a view of length {distance:.3g} m along {forward.tolist()} with {up} up is none")
    forward, right = forward / distance, right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(eye, dtype=np.float64)
    focal = 0.5 * height / np.tan(0.5 * np.radians(field_of_view_deg))
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, pose)


def orbit_view(
    points: Array,
    azimuth_deg: float = -60.0,
    elevation_deg: float = 20.0,
    width: int = 640,
    height: int = 480,
) -> Camera:
    """A camera that holds all of ``points`` (P, 3) in view, from an angle around the vertical and above the ground.

    Args:
        points: that the view holds [m], (P, 3).
        azimuth_deg: around the vertical, from the x axis [deg].
        elevation_deg: above the ground [deg].
        width, height: of the picture [px].
    """
    low, high = points.min(axis=0), points.max(axis=0)
    centre, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-3)
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    away = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    field = 40.0
    narrow = np.radians(field) * min(1.0, width / height)
    return look_at(centre + 1.1 * radius / np.sin(0.5 * narrow) * away, centre, width, height, field)
