"""Child process of the C3D import: parses one file with ezc3d, writes the arrays, prints labels and rate.

``python -m physworld_scenes.importers.c3d_child SOURCE TARGET``. Its memory is limited; it ends with status 1 and one
line on stderr when the file cannot be read.
"""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array

MEMORY_BYTES = 4 << 30


def main(source: str, target: str) -> None:
    """Parse ``source``; positions (T, N, 3) and residuals (T, N) go to ``target`` (npz)."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    positions, residuals, header = content_of(source)
    with Path(target).open("wb") as stream:
        np.savez(stream, positions=positions, residuals=residuals)
    print(json.dumps(header))


def content_of(source: str) -> tuple[Array, Array, dict[str, Any]]:
    """Positions (T, N, 3), residuals (T, N), and labels, unit and rate [Hz] of a C3D file, in this process."""
    import ezc3d

    content = ezc3d.c3d(source)
    point = content["parameters"]["POINT"]
    positions = np.asarray(content["data"]["points"], dtype=np.float64)[:3].transpose(2, 1, 0)
    residuals = np.asarray(content["data"]["meta_points"]["residuals"], dtype=np.float64)[0].T
    labels: list[str] = []
    for key in ("LABELS", *(f"LABELS{i}" for i in range(2, 10))):
        if key in point:
            labels += [str(label).strip() for label in point[key]["value"]]
    count = positions.shape[1]
    labels = (labels + [f"marker{i}" for i in range(len(labels), count)])[:count]
    units = point.get("UNITS", {}).get("value") or ["mm"]
    rate = point.get("RATE", {}).get("value")
    header = {
        "labels": labels,
        "unit": str(units[0]),
        "rate_hz": float(np.ravel(rate)[0]) if len(rate) else 0.0,
    }
    return positions, residuals, header


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
