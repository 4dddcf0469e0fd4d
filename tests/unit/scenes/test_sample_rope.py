"""The sample rope is what its script makes, and its time step is small enough."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from physworld_scenes.bundle import read_bundle, validate

REGENERATED_M = 2e-5
HALF_STEP_M = 5e-4  # the tracking noise; over the first 20 frames
FRAMES = 20


@pytest.fixture(scope="module")
def script(repository: Path) -> ModuleType:
    path = repository / "scripts" / "make_sample_rope.py"
    specification = importlib.util.spec_from_file_location("make_sample_rope", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module
    specification.loader.exec_module(module)
    return module


def test_the_rope_is_what_its_script_makes(repository: Path, script: ModuleType) -> None:
    scene = read_bundle(repository / "sample" / "hanging_rope")
    assert validate(scene) == ([], [])
    recipe = script.Recipe()
    path = script.simulate(recipe, FRAMES)
    assert np.abs(scene.controllers[:FRAMES] - path[:, [0, recipe.held - 1]]).max() < REGENERATED_M
    tracked = np.linspace(0, recipe.masses - 1, 13).round().astype(int)
    error = scene.points[:FRAMES] - path[:, tracked]
    assert error.std() == pytest.approx(recipe.noise_sigma_m, rel=0.1)
    assert np.linalg.norm(np.diff(path[:, -1], axis=0), axis=1).max() > 5e-3  # it moves
    coarse = dataclasses.replace(recipe, steps_per_frame=recipe.steps_per_frame // 2)
    assert np.linalg.norm(script.simulate(coarse, FRAMES) - path, axis=2).max() < HALF_STEP_M
