"""Checks of the tracking noise that a scene declares: one deviation for all, or a covariance for every point."""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.scene import sigma_of
from physworld_scenes.declaration import Declaration
from physworld_scenes.measured import Findings, some

NOISE_WARNING_SIZES = 0.1
LARGEST_CONDITION = 1e6
"""Of a covariance: a thousand times as noisy one way as another."""
NOISE_AGREES = 1.1
"""Factor between the deviation that is declared and that of the covariances."""


def check_noise(declaration: Declaration, object_size_m: float, findings: Findings) -> None:
    """A positive deviation, smaller than the object."""
    where = ["scene.json", "noise_sigma_m"]
    sigma = declaration.noise_sigma_m
    if sigma is None:
        findings.warn(where, "is not declared: intervals and the noise floor cannot be given")
    elif sigma <= 0.0:
        findings.fault(where, f"is {sigma:g} m; no tracker is exact, leave it null if it is not known")
    elif object_size_m > 0.0 and sigma > object_size_m:
        findings.fault(where, f"is {sigma:g} m, more than the object's size {object_size_m:.4g} m")
    elif object_size_m > 0.0 and sigma > NOISE_WARNING_SIZES * object_size_m:
        findings.warn(where, f"is {sigma:g} m, {sigma / object_size_m:.0%} of the object's size")


def check_covariances(declaration: Declaration, arrays: dict[str, Array], findings: Findings) -> None:
    """Covariances of the points' sightings: symmetric, positive, and of the size that ``noise_sigma_m`` says."""
    known = np.asarray(arrays.get("noise_covariance", np.zeros(0)), dtype=np.float64)
    if known.ndim != 3 or known.shape[1:] != (3, 3) or not known.size or not np.isfinite(known).all():
        return  # nothing, or told already
    where = ["scene.npz", "noise_covariance"]
    gap = np.abs(known - known.transpose(0, 2, 1)).max(axis=(1, 2))
    lopsided = np.flatnonzero(gap > 1e-6 * np.abs(known).max(axis=(1, 2)))
    if len(lopsided):
        findings.fault(where, f"is not symmetric at {len(lopsided)} of {len(known)} points: {some(lopsided)}")
        return
    least, most = np.linalg.eigvalsh(known)[:, [0, -1]].T
    flat = np.flatnonzero(~(least > most / LARGEST_CONDITION))
    if len(flat):
        worst = flat[np.argmin(least[flat])]
        findings.fault(
            where,
            f"is not positive definite, or more than {LARGEST_CONDITION:g} times as large one way as another, at "
            f"{len(flat)} of {len(known)} points: {some(flat)}; of point {worst} it reaches from {least[worst]:.3g} to "
            f"{most[worst]:.3g} m2",
        )
        return
    declared, found = declaration.noise_sigma_m, sigma_of(known)
    if declared is not None and not found / NOISE_AGREES <= declared <= found * NOISE_AGREES:
        findings.fault(
            ["scene.json", "noise_sigma_m"],
            f"is {declared:.4g} m, where noise_covariance has {found:.4g} m per axis; leave it null, or let them "
            f"agree to {NOISE_AGREES - 1.0:.0%}",
        )
