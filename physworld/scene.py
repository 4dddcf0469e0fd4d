"""A measured scene in memory: tracked points, driven controllers, and what is declared of the object.

SI units, world frame z up, axis order (time, entity, xyz). Reading and checking files is the business of
``storage``; everything here has passed the validator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from physworld.arrays import Array
from physworld.shapes.surface_mesh import SurfaceMesh

UNDEFORMED_AT_REST = "undeformed"
AS_MEASURED = "as measured"


@dataclass(frozen=True)
class Body:
    """Declared facts of the object; ``None`` means not known.

    Attributes:
        size_m: bounding box of the rest shape, (3,).
        box_min_m, box_max_m: corners of a box-shaped rest body in world axes, (3,).
        length_m: length of a rope, rod or arm.
        side_m: side of a square sheet.
        thickness_m: thickness of a sheet.
        radius_m: radius of a rope or rod.
        density_kg_m3, mass_kg: density, or total mass.
        segment_rest_lengths_m: rest distances between consecutive tracked points of a rope.
        edges: topology, index pairs (E, 2) into the tracked points.
        grid_shape: (n, n) when the tracked points form a grid on a sheet: point i * n + j is the i-th from the
            left and the j-th from the top.
    """

    size_m: Array | None = None
    box_min_m: Array | None = None
    box_max_m: Array | None = None
    length_m: float | None = None
    side_m: float | None = None
    thickness_m: float | None = None
    radius_m: float | None = None
    density_kg_m3: float | None = None
    mass_kg: float | None = None
    segment_rest_lengths_m: Array | None = None
    edges: Array | None = None
    grid_shape: tuple[int, int] | None = None


@dataclass(frozen=True)
class Ground:
    """A horizontal plane at ``height_m`` with Coulomb friction (None: not known)."""

    height_m: float
    friction: float | None = None


@dataclass(frozen=True)
class Grip:
    """A rigid gripper.

    Attributes:
        controllers: those that move as it does.
        region_min_m, region_max_m: box of undeformed material that it holds, (3,) [m], or None.
        points: tracked points inside it.
        radius_m: instead of a box: it holds the material within this distance [m] of any of its controllers at the
            first frame, and when it takes hold again.
        open_s: beginning and end of every time at which it holds nothing, in seconds from the first frame.
    """

    controllers: tuple[int, ...]
    region_min_m: Array | None = None
    region_max_m: Array | None = None
    points: tuple[int, ...] = ()
    radius_m: float | None = None
    open_s: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, eq=False)
class DeclaredCollider:
    """A rigid body beside the object: a pusher, a table, a peg.

    Its frame lies at ``position_m`` and ``quaternion_wxyz`` at the first frame. There it stays; or it is carried by
    controllers as by one rigid hand; or it follows the poses of an array.

    Attributes:
        name: its own.
        shape: sphere, box, capsule, cylinder, half_space or mesh.
        size_m: sides of a box, (3,).
        radius_m, length_m: of a sphere, capsule or cylinder; the axis is z, the ends of a capsule come on top.
        mesh: closed boundary in the collider's frame.
        friction: Coulomb's coefficient against the object; None: not known.
        position_m, quaternion_wxyz: pose at the first frame, (3,) and (4,).
        controllers: those that carry it.
        poses: name of the array in ``Scene.extra_arrays`` that holds its poses, (T, 7) at the frames or (Tc, 7) at
            the control samples: position [m] and unit quaternion, scalar first.
    """

    name: str
    shape: str
    size_m: Array | None = None
    radius_m: float | None = None
    length_m: float | None = None
    mesh: SurfaceMesh | None = None
    friction: float | None = None
    position_m: Array = field(default_factory=lambda: np.zeros(3))
    quaternion_wxyz: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    controllers: tuple[int, ...] = ()
    poses: str | None = None


@dataclass(frozen=True)
class Scene:
    """One recording.

    Attributes:
        points: measured material points [m], (T, N, 3) float64; meaningless where not visible.
        visible: (T, N) bool.
        controllers: driven or clamped points [m], (T, K, 3) float64.
        times: seconds from the first frame, (T,) float64, strictly increasing, not always even.
        gravity_m_s2: (3,).
        noise_sigma_m: tracking noise per axis, or None.
        controller_errors_m: what the controllers at the frames may err by, (E, T, K, 3): independent changes of all
            of them, one standard deviation each; None: nothing.
        noise_covariance_m2: of every sighting of each point, in world axes, (N, 3, 3), or None: the same noise along
            every axis. The root of a third of its mean trace is ``noise_sigma_m``.
        train, test: half-open frame ranges.
        initial_state: UNDEFORMED_AT_REST or AS_MEASURED.
        control_times, control_points: controllers at a higher rate, (Tc,) and (Tc, K, 3), or None.
        rest_volume_points: points filling the undeformed body at t = 0, (M, 3), or None.
        surface_points: further points on the surface at t = 0, (S, 3), or None.
        colors: colours of the tracked points, (T, N, 3) or (N, 3), or None.
        part_features: per-volume-point part features (M or N, F), or None.
        extra_arrays: measured arrays that no code here reads (base markers and the like), kept as they came.
        declared: the whole ``scene.json`` as it came, with what no field here holds (notes, topology, tip load,
            marker design places); where both speak, the fields count.
    """

    name: str
    kind: str
    points: Array
    visible: Array
    controllers: Array
    times: Array
    gravity_m_s2: Array
    noise_sigma_m: float | None
    train: tuple[int, int]
    test: tuple[int, int]
    initial_state: str = AS_MEASURED
    fps: float = 30.0
    description: str = ""
    body: Body = field(default_factory=Body)
    ground: Ground | None = None
    grips: tuple[Grip, ...] = ()
    colliders: tuple[DeclaredCollider, ...] = ()
    controller_velocities: Array | None = None
    controller_errors_m: Array | None = None
    control_times: Array | None = None
    control_points: Array | None = None
    rest_volume_points: Array | None = None
    surface_points: Array | None = None
    colors: Array | None = None
    part_features: Array | None = None
    noise_covariance_m2: Array | None = None
    extra_arrays: dict[str, Array] = field(default_factory=dict)
    declared: dict[str, Any] = field(default_factory=dict)

    @property
    def frame_count(self) -> int:
        """T."""
        return len(self.points)

    @cached_property
    def noise_factors(self) -> Array | None:
        """Lower triangular L of every point, (N, 3, 3), with L L^T its covariance over the square of
        ``noise_sigma_m``; None where every axis is as noisy.
        """
        if self.noise_covariance_m2 is None:
            return None
        return np.linalg.cholesky(self.noise_covariance_m2) / sigma_of(self.noise_covariance_m2)

    @cached_property
    def _weights(self) -> Array | None:
        return None if self.noise_factors is None else np.linalg.inv(self.noise_factors)

    def weighed(self, differences: Array) -> Array:
        """Differences (…, N, 3) [m], each times L^-1: as noisy as ``noise_sigma_m`` says in every direction."""
        return (
            differences
            if self._weights is None
            else np.einsum("nij,...nj->...ni", self._weights, differences)
        )

    def with_noise(self, sigma_m: float) -> Self:
        """The scene with this deviation per axis [m]; directions and points differ by the same factors as before."""
        known = self.noise_covariance_m2
        if known is not None:
            known = known * (sigma_m / sigma_of(known)) ** 2
        return replace(self, noise_sigma_m=sigma_m, noise_covariance_m2=known)

    def mistaken_controls(self) -> list[Array]:
        """Control points (T, K, 3) [m] at the frames, one standard deviation off by each of their errors; none where
        controllers are given at a higher rate."""
        if self.controller_errors_m is None or self.control_times is not None:
            return []
        return [self.controllers + error for error in self.controller_errors_m]

    def control_track(self) -> tuple[Array, Array]:
        """Times (Tc,) [s] and controller positions (Tc, K, 3) [m] at the best rate, none before the first frame."""
        clock, points = self.control_times, self.control_points
        if clock is None or points is None:
            return self.times, self.controllers
        start = self.times[0]
        if clock[0] >= start or clock[-1] <= start:
            return clock, points
        after = int(np.searchsorted(clock, start, side="right"))
        share = (start - clock[after - 1]) / (clock[after] - clock[after - 1])
        begin = (1.0 - share) * points[after - 1] + share * points[after]
        return np.concatenate([[start], clock[after:]]), np.concatenate([begin[None], points[after:]])


def sigma_of(covariances: Array) -> float:
    """Deviation per axis [m] of covariances (N, 3, 3) [m^2]: the root of a third of their mean trace."""
    return float(np.sqrt(np.trace(covariances, axis1=1, axis2=2).mean() / 3.0))


def covariances_of(scenes: Sequence[Scene]) -> Array | None:
    """Of the points of all scenes, (N1 + N2 + …, 3, 3) [m^2]; None where none has any."""
    if all(scene.noise_covariance_m2 is None for scene in scenes):
        return None
    worst = max(scene.noise_sigma_m or 0.0 for scene in scenes)
    alike = [np.tile(worst**2 * np.eye(3), (scene.points.shape[1], 1, 1)) for scene in scenes]
    known = [scene.noise_covariance_m2 for scene in scenes]
    return np.concatenate([own if one is None else one for one, own in zip(known, alike, strict=True)])
