"""What a first frame tells of a rope: places that are as noisy as any other frame's, and ends to a pixel."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from made_scene import made_scene, recorded_by

from physworld.calibrate import CalibrationConfig, FitResult, calibrate
from physworld.scene import UNDEFORMED_AT_REST, Body, Scene
from physworld.twin.build import build_twin

LENGTH_M, RADIUS_M, SIGMA_M, FRAMES = 0.4, 0.006, 1e-3, 30
LEFT = 1.2
"""Of the noise: sqrt 2 where the noise of frame 0 stays, and little more than 1 where it is taken off."""


def _swayed() -> Scene:
    points = np.zeros((12, 3))
    points[:, 2] = 1.0 - np.linspace(0.0, LENGTH_M, 12)
    hand = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0 - 0.05 * LENGTH_M]])
    scene = made_scene(
        points, "rope", hand, frames=FRAMES, initial_state=UNDEFORMED_AT_REST, noise_sigma_m=SIGMA_M,
        body=Body(length_m=LENGTH_M, radius_m=RADIUS_M, mass_kg=0.02),
    )  # fmt: skip
    sway = 0.1 * (1.0 - np.cos(6.0 * scene.times))[:, None, None] * np.array([1.0, 0.4, 0.0])
    return replace(scene, controllers=scene.controllers + sway)


@cache
def _fitted(cloud: bool) -> FitResult:
    scene = _swayed()
    twin = build_twin(scene).with_parameters(bending_n_m2=3e-4)
    noisy = recorded_by(twin, scene, SIGMA_M)
    if cloud:
        rng = np.random.default_rng(2)
        angle, along = rng.uniform(0.0, np.pi, 400), rng.uniform(0.0, LENGTH_M, 400)
        around = RADIUS_M * np.stack([np.cos(angle), -np.sin(angle)], axis=1)
        noisy = replace(noisy, surface_points=np.column_stack([around, 1.0 - along]))
    return calibrate(noisy, CalibrationConfig(damping="none", max_simulations=80))


def test_the_noise_of_its_first_frame_does_not_stay_in_a_rope() -> None:
    assert _fitted(cloud=False).losses["rms_over_noise"] < LEFT


def test_ends_that_a_cloud_tells_to_a_pixel_make_an_interval_wider() -> None:
    widths = []
    for cloud in (False, True):
        ends = _fitted(cloud).parameters["bending_n_m2"].ci95
        assert ends is not None
        widths.append(np.log(ends[1] / ends[0]))
    assert widths[1] > 1.2 * widths[0]
