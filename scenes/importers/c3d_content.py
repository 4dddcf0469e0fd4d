"""What ezc3d reads of a C3D file: places, residuals, labels, unit, rate, and which way the screen was."""

from __future__ import annotations

from typing import Any

import numpy as np

from physworld.arrays import Array


def content_of(source: str) -> tuple[dict[str, Array], dict[str, Any]]:
    """Positions (T, N, 3) and residuals (T, N); labels, unit, rate [Hz], X_SCREEN and Y_SCREEN of a C3D file."""
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
    facts = {
        "labels": labels,
        "unit": str(units[0]),
        "rate_hz": float(np.ravel(rate)[0]) if len(rate) else 0.0,
        "screen": [
            str((point.get(key, {}).get("value") or [""])[0]).strip() for key in ("X_SCREEN", "Y_SCREEN")
        ],
    }
    return {"positions": positions, "residuals": residuals}, facts
