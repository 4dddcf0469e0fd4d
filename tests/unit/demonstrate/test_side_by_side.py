"""Demonstrations side by side: the same episodes as one by one, the same rejections."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from physworld.demonstrate import DemonstrationConfig, derived_seed, make_episode, plan_episode
from physworld.demonstrate.side_by_side import make_episodes
from physworld.errors import SimulationError

CONFIG = DemonstrationConfig(frames=10)
OTHER_TIME_STEP = 5e-4  # [m] what a smaller time step changes; the motions are a hundred times as large
MODULUS_PA = 440.0  # so soft that some motions invert a cell or leave the workspace, and some do not


@pytest.fixture(scope="module")
def seeds(block, block_twin) -> list[int]:
    """A plain replay of the recording and two motions from rest."""
    motions = {seed: plan_episode(block, block_twin, CONFIG, seed).motion for seed in range(100)}
    return [next(seed for seed, motion in motions.items() if motion == "replay"), 0, 1]


def test_they_are_those_that_are_made_one_by_one(block, block_twin, seeds):
    seen = []
    made = make_episodes(block, block_twin, CONFIG, seeds, lambda done, total: seen.append((done, total)))
    for seed, (arrays, attributes) in zip(seeds, made, strict=True):
        alone, known = make_episode(block, block_twin, CONFIG, seed)
        assert attributes == known
        for name in ("times", "controllers", "properties"):
            np.testing.assert_array_equal(arrays[name], alone[name])
        assert arrays["particles"].dtype == alone["particles"].dtype
        np.testing.assert_allclose(arrays["particles"], alone["particles"], atol=OTHER_TIME_STEP)
        assert np.ptp(alone["particles"], axis=0).max() > 10 * OTHER_TIME_STEP
    assert seen[-1][0] == seen[-1][1]


def test_a_recording_that_starts_at_a_release_goes_beside_motions_from_rest(block, block_twin, seeds):
    let_go = replace(block_twin, release_s=0.05)
    (first, _), (second, _), _ = make_episodes(block, let_go, CONFIG, seeds)
    np.testing.assert_array_equal(first["particles"][1], first["particles"][0])  # still held at 1/30 s
    assert np.abs(second["particles"][1] - second["particles"][0]).max() > 1e-5


def test_what_is_rejected_is_planned_anew_and_has_its_reasons(block, block_twin):
    soft = block_twin.with_parameters(youngs_modulus_pa=MODULUS_PA)
    config = DemonstrationConfig(frames=40, attempts=2, replay_share=0.0)
    seeds = list(range(6))
    made = make_episodes(block, soft, config, seeds)
    kept = {seed: one for seed, one in zip(seeds, made, strict=True) if not isinstance(one, SimulationError)}
    assert any(attributes["rejected"] for _, attributes in kept.values())
    for seed, (arrays, attributes) in kept.items():
        tried = len(attributes["rejected"])
        assert attributes["seed"] == (derived_seed(seed, tried) if tried else seed)
        assert json.loads(json.dumps(attributes)) == attributes
        assert np.isfinite(arrays["particles"]).all()
        for rejection in attributes["rejected"]:
            assert any(digit.isdigit() for digit in rejection["reason"])


def test_after_its_last_attempt_an_episode_has_its_error(block, block_twin):
    jelly = block_twin.with_parameters(youngs_modulus_pa=100.0)
    made = make_episodes(block, jelly, DemonstrationConfig(frames=40, attempts=1), [0, 1])
    assert all(isinstance(one, SimulationError) for one in made)
