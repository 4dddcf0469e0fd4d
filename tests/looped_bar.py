"""Two recordings of one soft bar in air that drags on it: one slow, which hides the drag, one near its resonance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_scene import box_body, made_scene, recorded_by

from physworld.effects.registry import effect
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.twin.build import build_twin

BUDGET, TRUE_PA, DRAG_PER_S = 60, 5e4, 4.0
SIGMA_M, STROKE_M, SWELL_S, FRAMES, FPS = 3e-4, 0.005, 0.4, 120, 60.0
SLOW_HZ, RESONANT_HZ = 1.5, 2.6


def slow_bar() -> Scene:
    """The grip moves far below the bar's first resonance: its shape tells the stiffness, hardly the drag."""
    return _recorded("slow bar", SLOW_HZ, seed=0)


def shaken_bar() -> Scene:
    """The grip moves at the first resonance: only the drag bounds how far the bar swings."""
    return _recorded("shaken bar", RESONANT_HZ, seed=1)


def _recorded(name: str, hertz: float, seed: int) -> Scene:
    low, high = np.array([0.0, -0.015, -0.015]), np.array([0.16, 0.015, 0.015])
    times = np.arange(FRAMES) / FPS
    swell = np.clip(times / SWELL_S, 0.0, 1.0) ** 2 * (3.0 - 2.0 * np.clip(times / SWELL_S, 0.0, 1.0))
    lift = (STROKE_M * swell * np.sin(2 * np.pi * hertz * times))[:, None, None] * np.array([0.0, 0.0, 1.0])
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    points = [[x, y, 0.015] for x in np.linspace(0.06, 0.16, 3) for y in (-0.015, 0.015)]
    scene = made_scene(
        points, "beam", grip, FRAMES, name=name,
        body=box_body(low, high, density_kg_m3=500.0),
        initial_state=UNDEFORMED_AT_REST, grips=(Grip((0, 1, 2, 3), low, np.array([0.03, 0.015, 0.015])),),
    )  # fmt: skip
    scene = replace(scene, controllers=grip + lift, times=times, fps=FPS, gravity_m_s2=np.zeros(3))
    twin = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=TRUE_PA)
    return recorded_by(
        twin.with_effect(effect("air_drag_linear", rate_per_s=DRAG_PER_S)), scene, SIGMA_M, seed
    )
