"""What an active stereo camera makes of an exact picture: noise that grows with distance, holes, steps.

Depth Z has the disparity f b / Z; its error is white in disparity, smoothed over the matching window, in part the same
in every frame (the camera's own pattern). So the noise of Z is Z² / (f b) times that of the disparity: 1.5 mm at
0.8 m. Along edges of depth the stereo match is lost or mixes the two sides. Depth is stored in whole millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from physworld.arrays import Array


@dataclass(frozen=True)
class DepthCamera:
    """Errors of the recordings.

    Attributes:
        baseline_m: between the two eyes.
        disparity_px: deviation of a pixel's disparity.
        window_px: deviation of the Gaussian over which errors are alike.
        fixed_share: of the variance that is the same in every frame.
        edge_step_m, edge_px: a step of depth of that size loses pixels up to so far from it.
        edge_lost: share of them that is lost.
        hole_share: of all other pixels, in blobs.
        grey_levels: deviation of a colour's noise, of 255.
    """

    baseline_m: float = 0.055
    disparity_px: float = 0.08
    window_px: float = 1.2
    fixed_share: float = 0.25
    edge_step_m: float = 0.02
    edge_px: int = 2
    edge_lost: float = 0.7
    hole_share: float = 0.01
    grey_levels: float = 2.0

    def pattern(self, shape: tuple[int, int], rng: np.random.Generator) -> Array:
        """The camera's own error of disparity [px], (H, W)."""
        return self._smooth(shape, rng) * self.disparity_px * self.fixed_share**0.5

    def depth_mm(self, exact_m: Array, focal_px: float, pattern: Array, rng: np.random.Generator) -> Array:
        """Measured depth (H, W) uint16 [mm], 0 for a hole.

        Args:
            exact_m: (H, W) [m].
            focal_px: focal length.
            pattern: of ``pattern``.
            rng: of the frame.
        """
        shape = exact_m.shape
        high, low = (
            f(exact_m, np.ones((2 * self.edge_px + 1,) * 2, np.uint8)) for f in (cv2.dilate, cv2.erode)
        )
        edge = high - low > self.edge_step_m
        mixed = np.where(edge, cv2.blur(exact_m, (3, 3)), exact_m)
        fresh = self._smooth(shape, rng) * self.disparity_px * (1.0 - self.fixed_share) ** 0.5
        scale = focal_px * self.baseline_m
        depth = scale / (scale / mixed + fresh + pattern)
        blobs = self._smooth(shape, rng, 3.0) > _upper_quantile(self.hole_share)
        lost = (edge & (rng.random(shape) < self.edge_lost)) | blobs
        depth = np.where(lost, 0.0, depth)
        return np.clip(np.round(depth * 1000.0), 0, 65535).astype(np.uint16)

    def colour(self, exact: Array, rng: np.random.Generator) -> Array:
        """Noisy colours (H, W, 3) uint8 of exact ones in 0 to 255."""
        return np.clip(np.round(exact + rng.normal(scale=self.grey_levels, size=exact.shape)), 0, 255).astype(
            np.uint8
        )

    def _smooth(
        self, shape: tuple[int, ...], rng: np.random.Generator, window_px: float | None = None
    ) -> Array:
        """Unit noise that is alike over the matching window, (H, W)."""
        width = window_px or self.window_px
        noise = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), width)
        return noise * (2.0 * np.sqrt(np.pi) * width)


def _upper_quantile(share: float) -> float:
    from statistics import NormalDist

    return NormalDist().inv_cdf(1.0 - share)
