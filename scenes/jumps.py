"""Check of what was measured for jumps: a tracker that swapped two points. ``measured.py`` has the other checks."""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld_scenes.measured import Findings, Measured

FASTEST_POINT_M_S = 50.0
"""Ten times the fastest recorded whip at hand (4.6 m/s); beyond it, a tracker swapped two points."""


def check_jumps(measured: Measured, findings: Findings) -> None:
    """No point moves faster than anything recorded, nor by more than the object's size in one frame."""
    where = ["scene.npz", "points"]
    step = np.diff(measured.times)
    if (step <= 0.0).any() or not np.isfinite(step).all():
        return
    speed = np.zeros((len(step), measured.seen.shape[1]))
    far, first = 0, None
    for t in range(len(step)):
        both = np.flatnonzero(measured.seen[t] & measured.seen[t + 1])
        length = np.linalg.norm(measured.points[t + 1, both] - measured.points[t, both], axis=1)
        speed[t, both] = length / step[t]
        long = np.flatnonzero((length > measured.size_m) & (speed[t, both] <= FASTEST_POINT_M_S))
        far += len(long)
        if first is None and len(long):
            first = (t, int(both[long[0]]), float(length[long[0]]))
    _name_jumps(where, speed, speed > FASTEST_POINT_M_S, f"faster than {FASTEST_POINT_M_S:g} m/s", findings)
    if measured.controllers.shape[1]:
        driven = np.linalg.norm(np.diff(measured.controllers, axis=0), axis=2) / step[:, None]
        limit = f"faster than {FASTEST_POINT_M_S:g} m/s"
        _name_jumps(["scene.npz", "controllers"], driven, driven > FASTEST_POINT_M_S, limit, findings)
    if first is not None and measured.seen.shape[1] > 1:
        t, i, reach = first
        findings.warn(
            where,
            f"{far} steps are longer than the object ({measured.size_m:.3g} m), first point {i}"
            f" into frame {t + 1} by {reach:.3g} m",
        )


def _name_jumps(where: list[str], speed: Array, bad: Array, limit: str, findings: Findings) -> None:
    if not bad.any():
        return
    t, i = np.unravel_index(int(np.argmax(np.where(bad, speed, 0.0))), speed.shape)
    first_t, first_i = np.argwhere(bad)[0]
    findings.fault(
        where,
        f"{int(bad.sum())} steps are {limit}, first point {first_i} into frame {first_t + 1}"
        f" at {speed[first_t, first_i]:.3g} m/s, the fastest point {i} into frame {t + 1}"
        f" at {speed[t, i]:.3g} m/s",
    )
