"""Whether a world model's energy grows without end: its rollout goes on with still grips.

    e^t = 1/(2n) Σ_i |x_i^{t+1} - x_i^t|² / dt²        kinetic energy per mass [m²/s²]

An elastic body whose grips stand still swings on or comes to rest; it gains nothing. A learned step has no such law,
and what grows slowly over a recording's two seconds fills a session of a minute. The recording's controllers are
followed by as long a time at their last place, at least ``STILL_TICKS``; e is averaged over the quarters of that time,
so that the exchange with potential energy in each swing does not count. Nothing is judged here: see
``physworld_schemas.quality``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.worldmodel.published import PublishedModel

STILL_TICKS = 300
QUARTERS = 4


def still_energy(published: PublishedModel, controllers: Array) -> dict[str, Any]:
    """Kinetic energy of the rollout under ``controllers`` (T, K, 3) [m] and while they stand still afterwards.

    Returns:
        ``still_ticks``; ``still_quarters_m2_s2``: mean of e over each quarter of them; ``moving_peak_m2_s2``: largest e
        before. A number that is not finite stands for a rollout that left the numbers.
    """
    ticks = max(STILL_TICKS, len(controllers))
    path = published.rollout(np.concatenate([controllers, np.repeat(controllers[-1:], ticks, axis=0)]))
    energy = kinetic_energy(path, published.spec.dt_s)
    moving, still = energy[: len(controllers) - 1], energy[len(controllers) - 1 :]
    return {
        "still_ticks": ticks,
        "still_quarters_m2_s2": [float(part.mean()) for part in np.array_split(still, QUARTERS)],
        "moving_peak_m2_s2": float(moving.max()),
    }


def kinetic_energy(path: Array, dt_s: float) -> Array:
    """e of vertices (T, n, 3) [m] that are ``dt_s`` apart, (T - 1,) [m²/s²]; NaN or infinite where they are."""
    with np.errstate(over="ignore", invalid="ignore"):
        moved: Array = (np.diff(path, axis=0) ** 2).sum(axis=2).mean(axis=1) / (2.0 * dt_s**2)
    return moved
