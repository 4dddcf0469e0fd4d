"""A soft bar between two hands, for grips that let go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_scene import box_body, made_scene

from physworld.scene import Grip, Scene

LONG = 0.2
TIMES = np.arange(31) / 60.0
BAR = {"youngs_modulus_pa": 2e5}


def hand(x: float) -> np.ndarray:
    """Four control points around an end of the bar, (4, 3) [m]."""
    return np.array([[x, y, z] for y in (-0.02, 0.02) for z in (-0.02, 0.02)])


def two_handed_bar() -> Scene:
    """A bar along x between two hands."""
    places = np.stack(np.meshgrid(np.linspace(0, LONG, 9), (-0.02, 0.02), (-0.02, 0.02), indexing="ij"), -1)
    low, high = np.array([0.0, -0.02, -0.02]), np.array([LONG, 0.02, 0.02])
    reach = np.array([0.03, 0.05, 0.05])
    grips = (
        Grip((0, 1, 2, 3), low - 0.01, low + reach),
        Grip((4, 5, 6, 7), high - reach, high + 0.01),
    )
    return made_scene(
        places.reshape(-1, 3), "beam", np.concatenate([hand(0.0), hand(LONG)]), len(TIMES),
        body=box_body(low, high, density_kg_m3=1000.0), grips=grips, times=TIMES, initial_state="undeformed",
    )  # fmt: skip


def opened(grip: Grip, *spans: tuple[float, float], radius_m: float | None = None) -> Grip:
    return replace(grip, open_s=spans, radius_m=radius_m)
