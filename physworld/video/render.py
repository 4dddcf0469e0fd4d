"""Pictures of 3D Gaussians by splatting (Kerbl et al. 2023), on the CPU and on CUDA by the same Warp kernel.

Gaussians are projected (:mod:`physworld.video.projection`), sorted by depth and blended front to back; opacity below
1/255 and what lies behind 99.99 % of coverage is left out. Colour is a sum of spherical harmonics in the direction
from the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.devices import default_device
from physworld.video.blending import Canvas, blended
from physworld.video.gaussians import SH_DC, Gaussians
from physworld.video.projection import matrices, project, tiles

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
        self,
        camera: Camera,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        device: str | None = None,
    ) -> None:
        self.camera, self.device = camera, device or default_device()
        self.background = background

    def render(self, gaussians: Gaussians, turn: Array | None = None) -> Picture:
        """A frame.

        Args:
            gaussians: the splat where it is now.
            turn: what each Gaussian was turned by since its colours were learnt, quaternions (G, 4); None: not.

        Raises:
            ValueError: so many large splats that their tiles do not fit the memory.
        """
        canvas, inputs = self.prepared(gaussians, turn)
        shape = (canvas.height, canvas.width)
        rgb, alpha, far = (output.numpy() for output in blended(canvas, inputs))
        covered = np.where(alpha > 0, alpha, 1.0)
        return Picture(
            np.clip(rgb, 0, 1).reshape(*shape, 3), alpha.reshape(shape), (far / covered).reshape(shape)
        )

    def prepared(self, gaussians: Gaussians, turn: Array | None = None) -> tuple[Canvas, list[Any]]:
        """What ``blended`` takes of a frame; see ``render``."""
        camera = self.camera
        with torch.no_grad():
            seen = project(
                torch.from_numpy(gaussians.means),
                torch.from_numpy(gaussians.log_scales),
                torch.from_numpy(gaussians.rotations),
                camera,
            )
        centre, conic, depth = (tensor.numpy() for tensor in (seen.centre, seen.conic, seen.depth))
        starts, order = tiles(centre, seen.reach, depth, seen.good, camera.width, camera.height)
        canvas = Canvas(camera.width, camera.height, starts, order, self.background, self.device)
        return canvas, canvas.arrays(
            centre, conic, gaussians.opacities, self._colours(gaussians, turn), depth
        )

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
    return np.asarray(matrices(torch.from_numpy(quaternions)).numpy())


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
