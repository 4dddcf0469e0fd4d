"""Pictures of 3D Gaussians by splatting (Kerbl et al. 2023), on the CPU and on CUDA by the same Warp kernel.

A Gaussian N(p, Σ) seen by a pinhole camera is, to first order in its size, a Gaussian in the picture with
Σ' = J W Σ Wᵀ Jᵀ + 0.3 px² I (Zwicker et al. 2001, "EWA splatting"), W the camera's rotation and J the projection's
derivative at p. Gaussians are sorted by depth and blended front to back; opacity below 1/255 and what lies behind
99.99 % of coverage is left out. Colour is a sum of spherical harmonics in the direction from the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.video.gaussians import SH_DC, Gaussians
from physworld.video.render_kernels import TILE, blend

_NEAR_M = 1e-2
_BLUR_PX2 = 0.3
_BEYOND = 1.3  # tangents outside of the picture's, at which the projection's derivative is held
_REACH = 3.0  # standard deviations that a splat covers
_MOST_PAIRS = 100_000_000

_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
    1.445305721320277, -0.5900435899266435,
)  # fmt: skip


@dataclass(frozen=True)
class Picture:
    """A frame: ``rgb`` (H, W, 3) in [0, 1], ``alpha`` (H, W) coverage, ``depth`` (H, W) [m], 0 where nothing is."""

    rgb: Array
    alpha: Array
    depth: Array


class Renderer:
    """Renders splats for one camera.

    Args:
        camera: where from.
        background: colour where nothing is, in [0, 1].
        device: Warp device.
    """

    def __init__(
        self, camera: Camera, background: tuple[float, float, float] = (1.0, 1.0, 1.0), device: str = "cpu"
    ) -> None:
        self.camera, self.device = camera, device
        self.background = wp.vec3f(*background)

    def render(self, gaussians: Gaussians, turn: Array | None = None) -> Picture:
        """A frame.

        Args:
            gaussians: the splat where it is now.
            turn: what each Gaussian was turned by since its colours were learnt, quaternions (G, 4); None: not.

        Raises:
            ValueError: so many large splats that their tiles do not fit the memory.
        """
        camera, pose = self.camera, self.camera.world_to_camera
        local = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
        front = local[:, 2] > _NEAR_M
        covariance = self._projected_covariance(gaussians, local)
        determinant = covariance[:, 0] * covariance[:, 2] - covariance[:, 1] ** 2
        middle = 0.5 * (covariance[:, 0] + covariance[:, 2])
        largest = middle + np.sqrt(np.maximum(middle**2 - determinant, 0.0))
        radius = _REACH * np.sqrt(np.maximum(largest, 0.0))
        depth = np.where(front, local[:, 2], 1.0)
        centre = np.stack(
            [
                camera.fx * local[:, 0] / depth + camera.cx,
                camera.fy * local[:, 1] / depth + camera.cy,
            ],
            axis=1,
        )
        good = front & (determinant > 0) & np.isfinite(radius)
        starts, order = self._tiles(centre, radius, local[:, 2], good)
        safe = np.where(good, determinant, 1.0)
        conic = np.stack([covariance[:, 2], -covariance[:, 1], covariance[:, 0]], axis=1) / safe[:, None]
        pixels = camera.width * camera.height
        outputs = [
            wp.zeros(pixels, dtype=kind, device=self.device) for kind in (wp.vec3f, wp.float32, wp.float32)
        ]
        inputs = [
            self._array(starts, wp.int32),
            self._array(order, wp.int32),
            self._array(centre, wp.vec2f),
            self._array(conic, wp.vec3f),
            self._array(gaussians.opacities, wp.float32),
            self._array(self._colours(gaussians, turn), wp.vec3f),
            self._array(local[:, 2], wp.float32),
        ]
        wp.launch(
            blend,
            dim=pixels,
            inputs=[camera.width, -(-camera.width // TILE), *inputs, self.background, *outputs],
            device=self.device,
        )
        shape = (camera.height, camera.width)
        rgb, alpha, far = (output.numpy() for output in outputs)
        covered = np.where(alpha > 0, alpha, 1.0)
        return Picture(
            np.clip(rgb, 0, 1).reshape(*shape, 3), alpha.reshape(shape), (far / covered).reshape(shape)
        )

    def _array(self, values: Array, kind: type) -> wp.array:
        plain = np.int32 if kind is wp.int32 else np.float32
        return wp.array(np.ascontiguousarray(values, dtype=plain), dtype=kind, device=self.device)

    def _projected_covariance(self, gaussians: Gaussians, local: Array) -> Array:
        """Σ' (G, 3) as (xx, xy, yy) [px²]."""
        camera = self.camera
        depth = np.maximum(local[:, 2], _NEAR_M)
        limit = _BEYOND * np.array([camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)])
        x, y = (np.clip(local[:, :2] / depth[:, None], -limit, limit) * depth[:, None]).T
        jacobian = np.zeros((len(local), 2, 3))
        jacobian[:, 0, 0], jacobian[:, 0, 2] = camera.fx / depth, -camera.fx * x / depth**2
        jacobian[:, 1, 1], jacobian[:, 1, 2] = camera.fy / depth, -camera.fy * y / depth**2
        axes = rotation_matrices(gaussians.rotations) * np.exp(gaussians.log_scales)[:, None, :]
        seen = jacobian @ camera.world_to_camera[:3, :3] @ axes
        flat = seen @ seen.transpose(0, 2, 1)
        return np.stack([flat[:, 0, 0] + _BLUR_PX2, flat[:, 0, 1], flat[:, 1, 1] + _BLUR_PX2], axis=1)

    def _tiles(self, centre: Array, radius: Array, depth: Array, good: Array) -> tuple[Array, Array]:
        """Gaussians of every tile, nearest first: ``order``, and where each tile's begin (tiles + 1,)."""
        across, down = -(-self.camera.width // TILE), -(-self.camera.height // TILE)
        number = np.flatnonzero(good)
        with np.errstate(invalid="ignore", over="ignore"):
            low = np.floor((centre[number] - radius[number, None]) / TILE)
            high = np.floor((centre[number] + radius[number, None]) / TILE) + 1
        low = np.clip(low, 0, [across, down]).astype(np.int64)
        high = np.clip(high, 0, [across, down]).astype(np.int64)
        size = np.maximum(high - low, 0)
        count = size[:, 0] * size[:, 1]
        if count.sum() > _MOST_PAIRS:
            raise ValueError(
                f"{count.sum()} pairs of splat and tile, more than {_MOST_PAIRS}: splats of up to "
                f"{radius[number].max():.3g} px"
            )
        which = np.repeat(np.arange(len(number)), count)
        place = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        column = low[which, 0] + place % np.maximum(size[which, 0], 1)
        row = low[which, 1] + place // np.maximum(size[which, 0], 1)
        tile = row * across + column
        sorted_pairs = np.lexsort((depth[number[which]], tile))
        starts = np.searchsorted(tile[sorted_pairs], np.arange(across * down + 1))
        return starts, number[which[sorted_pairs]]

    def _colours(self, gaussians: Gaussians, turn: Array | None) -> Array:
        """Colour of every Gaussian as seen from the camera, (G, 3), not below 0."""
        harmonics = gaussians.harmonics
        colour = SH_DC * harmonics[:, 0]
        if harmonics.shape[1] > 1:
            direction = gaussians.means - self.camera.centre
            direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
            if turn is not None:
                direction = np.einsum(
                    "gyx,gy->gx", rotation_matrices(turn), direction
                )  # back into the rest state
            colour = colour + np.einsum(
                "gc,gcx->gx", _basis(direction)[:, : harmonics.shape[1] - 1], harmonics[:, 1:]
            )
        shown: Array = np.maximum(colour + 0.5, 0.0)
        return shown


def rotation_matrices(quaternions: Array) -> Array:
    """(G, 3, 3) of unit quaternions (G, 4), (w, x, y, z)."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def _basis(direction: Array) -> Array:
    """Real spherical harmonics of degrees 1 to 3 in the order and signs of the PLY's coefficients, (G, 15)."""
    x, y, z = direction.T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack(
        [
            -_C1 * y, _C1 * z, -_C1 * x,
            _C2[0] * x * y, _C2[1] * y * z, _C2[2] * (2 * zz - xx - yy), _C2[3] * x * z, _C2[4] * (xx - yy),
            _C3[0] * y * (3 * xx - yy), _C3[1] * x * y * z, _C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy), _C3[4] * x * (4 * zz - xx - yy), _C3[5] * z * (xx - yy),
            _C3[6] * x * (xx - 3 * yy),
        ],
        axis=1,
    )  # fmt: skip
