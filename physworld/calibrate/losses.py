"""How far a prediction is from the training frames: the paper's loss, and the likelihood under the declared noise.

L = lambda_1 CD + lambda_2 L_track        CD: two-way Euclidean Chamfer distance, lambda_1 = 1
L_track = sum smooth-L1(dx) / (3 |V|)     over coordinates of visible points, lambda_2 = 0.1, smooth-L1 with beta 1 m
chi^2 / n = mean (dx / sigma)^2           1 for a perfect model; frame 0 places the points, so up to 2 before the
                                          points' own places are estimated
"""

from __future__ import annotations

from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.evaluate.metrics import chamfer_l2
from physworld.scene import Scene

CHAMFER_WEIGHT, TRACK_WEIGHT = 1.0, 0.1


def training_losses(scene: Scene, tracks: Array) -> dict[str, Any]:
    """Losses of predicted tracks (T, N, 3) on the training frames, frame 0 left out.

    Returns:
        ``paper``: ``total``, ``chamfer_m``, ``track_smooth_l1``; ``rms_m``: root mean squared coordinate error;
        ``noise_sigma_m``, ``chi2_per_residual`` and ``rms_over_noise``, None where no noise is declared.
    """
    window = slice(max(scene.train[0], 1), scene.train[1])
    visible, measured, predicted = scene.visible[window], scene.points[window], tracks[window]
    error = (predicted - measured)[visible]
    size = np.abs(error)
    smooth = np.where(size < 1.0, 0.5 * error**2, size - 0.5)
    chamfer = chamfer_l2(predicted, measured, visible)
    track = float(smooth.sum() / (3 * max(len(error), 1)))
    square = float(np.mean(error**2))
    sigma = scene.noise_sigma_m
    return {
        "paper": {
            "total": CHAMFER_WEIGHT * chamfer + TRACK_WEIGHT * track,
            "chamfer_m": chamfer,
            "track_smooth_l1": track,
        },
        "rms_m": float(np.sqrt(square)),
        "noise_sigma_m": sigma,
        "chi2_per_residual": square / sigma**2 if sigma else None,
        "rms_over_noise": float(np.sqrt(square)) / sigma if sigma else None,
    }
