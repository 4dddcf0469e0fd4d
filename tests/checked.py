"""A small report of a check, as its handler stores it."""

from __future__ import annotations

from typing import Any


def _view(share: float, detectable: float, status: str) -> dict[str, Any]:
    gate = {"name": "rate_per_s", "unit": "1/s", "plausible": 1.73, "most": 30.0, "detectable": detectable}
    modulus = {
        "name": "youngs_modulus_pa", "unit": "Pa", "value": 2.0e5, "value_is": "prior", "prior95": [1e3, 1e8],
        "expected95": [1.9e5, 2.1e5], "ratio": 0.0125, "optional": False,
    }  # fmt: skip
    drag = {
        "name": "air_drag_linear", "label": "air_drag_linear", "title": "linear air drag", "status": status,
        "multiple": detectable / 1.73, "gates": [gate], "shapes": 1, "visible_shapes": 1, "hidden_by": {},
    }  # fmt: skip
    bump = {
        **drag, "name": "stiffness_field", "label": "stiffness_field.bump", "status": "invisible", "multiple": None,
        "gates": [{**gate, "name": "bump", "unit": "1", "detectable": None}], "shapes": 3, "visible_shapes": 0,
        "hidden_by": {"youngs_modulus_pa": 0.97},
    }  # fmt: skip
    pair = {
        "labels": ["actuation_lag", "measurement_clock"],
        "correlation": 0.998,
        "apart_from_multiple": 1.4,
    }
    return {
        "discrepancy_m": share * 0.02, "discrepancy_share": share, "parameters": [modulus], "effects": [drag, bump],
        "pairs": [pair], "groups": [["actuation_lag", "measurement_clock"]],
    }  # fmt: skip


REPORT: dict[str, Any] = {
    "schema_version": 1,
    "scene": "strip",
    "formulation": "total Lagrangian",
    "law": "NeoHookean",
    "noise_m": 1e-4,
    "noise_is": "declared",
    "motion_m": 0.02,
    "frames": 14,
    "views": [_view(0.0, 0.04, "visible"), _view(0.03, 4.25, "only_if_large")],
    "proposal": {
        "description": "Shake the grip along <x>; film 2 s at 30 frames per second.",
        "motion": "shake",
        "times_s": [0.0, 1.0],
        "controllers": [[[0.0, 0.0, 0.5]], [[0.01, 0.0, 0.5]]],
        "frame_times_s": [0.0, 1.0],
        "shows": [
            {"labels": ["air_drag_linear"], "before_multiple": 2.46, "after_multiple": 0.7, "shown": True}
        ],
        "separates": [],
        "tried": 6,
        "instead": [],
    },
    "asked": {"air_drag_linear": 1, "stiffness_field": 3},
    "refused": {"adhesion": "the body touches no ground"},
    "simulations": 41,
    "seconds": 3.2,
}
