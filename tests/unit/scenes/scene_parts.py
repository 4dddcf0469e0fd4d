"""A small sound scene as its two files hold it, for tests to break one thing at a time."""

from __future__ import annotations

from typing import Any

import numpy as np

FRAMES, POINTS, CONTROLLERS = 30, 25, 4
SIGMA = 1e-3


def sound_parts() -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """``scene.json`` and arrays of a beam of 0.3 x 0.04 x 0.04 m that a gripper at x = 0 lifts."""
    rng = np.random.default_rng(11)
    rest = rng.uniform([0.0, 0.0, 0.5], [0.3, 0.04, 0.54], (POINTS, 3))
    corners = np.array([[0.0, 0.0, 0.5], [0.3, 0.04, 0.54]])
    rest[:2] = corners
    lift = np.zeros((FRAMES, 1, 3))
    lift[:, 0, 2] = 0.1 * np.linspace(0.0, 1.0, FRAMES) ** 2
    points = (rest + lift + rng.normal(0.0, SIGMA, (FRAMES, POINTS, 3))).astype(np.float32)
    visible = np.ones((FRAMES, POINTS), dtype=bool)
    visible[5:9, 3] = False
    points[~visible] = 0.0
    grip = np.array([[0.0, 0.0, 0.5], [0.0, 0.04, 0.5], [0.0, 0.0, 0.54], [0.0, 0.04, 0.54]])
    arrays = {
        "points": points,
        "visible": visible,
        "controllers": (grip + lift).astype(np.float32),
        "times": np.arange(FRAMES) / 30.0,
        "rest_volume_points": rng.uniform(corners[0], corners[1], (200, 3)).astype(np.float32),
        "base_markers": rng.normal(size=(FRAMES, 2, 3)).astype(np.float32),
    }
    declared = {
        "schema_version": 1,
        "name": "test_beam",
        "kind": "beam",
        "description": "a test",
        "fps": 30.0,
        "gravity_m_s2": [0, 0, -9.81],
        "noise_sigma_m": SIGMA,
        "split": {"train": [0, 21], "test": [21, 30]},
        "initial_state": "undeformed and at rest at t=0; gravity acts from t=0",
        "body": {
            "size_m": [0.3, 0.04, 0.04],
            "density_kg_m3": 1000.0,
            "mass_kg": None,
            "material": "rubber",
            "topology": {"edges": [[0, 1], [1, 2]], "main_points": [0, 1]},
            "segment_rest_lengths_m": [0.1, 0.1],
            "tip_load": {"mass_kg": 0.05, "where": "tip"},
        },
        "ground": {"height_m": 0.0, "friction": 0.5},
        "grips": [
            {
                "controllers": [0, 1, 2, 3],
                "region_min_m": [0.0, 0.0, 0.5],
                "region_max_m": [0.05, 0.04, 0.54],
                "points": [0],
            }
        ],
        "notes": {"source": {"licence": "none"}, "caveats": ["a", "ü"]},
    }
    return declared, arrays
