"""Twins move on a GPU as on a CPU, alone and side by side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import FPS
from three_scenes import SCENES

from physworld.twin.batch import Episode, simulate_batch
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

FRAMES = 12
MOVED_M = 0.02  # what the grips do
SAME_M = {"auto": 2e-5, "updated_lagrangian": 2e-4}
"""Solids strain in single precision, sums have another order, and the ground of the updated form pushes all particles
at once on a GPU, one after another on a CPU."""


def lifted(twin: Twin, direction: float) -> Episode:
    times = np.arange(FRAMES) / FPS
    shift = MOVED_M * np.sin(0.5 * np.pi * times * FPS / 10)[:, None, None] ** 2 * [0.3 * direction, 0.2, 1.0]
    return Episode(times, twin.controllers_start + shift, times)


def nodes_of(twin: Twin, one: Episode) -> np.ndarray:
    return twin.simulate(one.control_times, one.control_points, one.frame_times)


@pytest.mark.parametrize("formulation", ["auto", "updated_lagrangian"])
@pytest.mark.parametrize("shape", SCENES)
def test_a_twin_moves_as_on_a_cpu(shape: str, formulation: str, gpu: str) -> None:
    if shape != "solid" and formulation != "auto":
        pytest.skip("the updated form is of solids")
    here, there = (
        build_twin(SCENES[shape](FRAMES), 400, device=device, formulation=formulation)
        for device in ("cpu", gpu)
    )
    one = lifted(here, 1.0)
    expected, found = nodes_of(here, one), nodes_of(there, one)
    assert np.abs(expected - expected[0]).max() > 0.3 * MOVED_M
    assert np.abs(found - expected).max() < SAME_M[formulation]


@pytest.mark.parametrize("shape", SCENES)
def test_episodes_side_by_side_move_as_on_a_cpu(shape: str, gpu: str) -> None:
    here = build_twin(SCENES[shape](FRAMES), 400, device="cpu")
    there = replace(here, device=gpu)
    episodes = [lifted(here, direction) for direction in np.linspace(-1.0, 1.0, 16)]
    expected, found = (
        [outcome.trusted() for outcome in simulate_batch(twin, episodes)] for twin in (here, there)
    )
    assert np.abs(expected[0] - expected[-1]).max() > 1e-3
    for one, other in zip(expected, found, strict=True):
        assert np.abs(one - other).max() < SAME_M["auto"]
