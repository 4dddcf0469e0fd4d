"""A recording of a bar that starts level, sags and rings under its weight, made by a twin of the fit's own cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_scene import box_body, made_scene

from physworld.effects.base import Effect
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.twin.build import build_twin

BUDGET, TRUE_PA, SIGMA = 60, 5e4, 5e-4


def sagging(*effects: Effect, frames: int = 20) -> Scene:
    """The bar with these effects in it and noise of ``SIGMA`` [m] on its six points."""
    low, high = np.array([0.0, -0.015, -0.015]), np.array([0.16, 0.015, 0.015])
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    points = [[x, y, 0.015] for x in np.linspace(0.06, 0.16, 3) for y in (-0.015, 0.015)]
    scene = made_scene(
        points, "beam", grip, frames, body=box_body(low, high, density_kg_m3=500.0),
        initial_state=UNDEFORMED_AT_REST, grips=(Grip((0, 1, 2, 3), low, np.array([0.03, 0.015, 0.015])),),
    )  # fmt: skip
    twin = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=TRUE_PA)
    for known in effects:
        twin = twin.with_effect(known)
    tracks = twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)
    noise = np.random.default_rng(0).normal(scale=SIGMA, size=tracks.shape)
    return replace(scene, points=tracks + noise, noise_sigma_m=SIGMA)
