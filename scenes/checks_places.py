"""Check of a scene's places: none lies absurdly far from the origin.

What is computed with a place of 1e300 m overflows, and single precision no longer resolves a tracking error at 1 km.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld_scenes.checks_measured import Findings, Measured, unit_hint
from physworld_schemas.arrays import FARTHEST_M

PLACES = ("points", "controllers", "ctrl_points", "rest_volume_points", "surface_points")


def check_places(arrays: dict[str, Array], measured: Measured, findings: Findings) -> bool:
    """Whether all places are within ``FARTHEST_M`` of the origin along each axis; the others are named."""
    near = True
    cleaned = {"points": measured.points, "controllers": measured.controllers}
    for name in PLACES:
        given = cleaned.get(name, arrays.get(name))
        if given is None or not given.size or given.dtype.kind not in "fiu":
            continue
        far = np.nan_to_num(np.abs(given.astype(np.float64)), posinf=0.0)  # those are another check's
        if far.max() > FARTHEST_M:
            first = tuple(int(i) for i in np.unravel_index(int(far.argmax()), far.shape))
            findings.fault(
                ["scene.npz", name],
                f"{int((far > FARTHEST_M).sum())} of {far.size} values are farther than {FARTHEST_M:g} m from the"
                " origin,"
                f" the farthest {far.max():.4g} m at {first}: not metres?{unit_hint(measured.size_m)}",
            )
            near = False
    return near
