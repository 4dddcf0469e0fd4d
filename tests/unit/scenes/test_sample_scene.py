"""The sample scene is what its script makes, small, sound, and not solved by a baseline."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from physworld.evaluate.table import held_out_table
from physworld.scene import UNDEFORMED_AT_REST, Scene
from physworld_scenes.bundle import read_bundle, validate

REGENERATED = 2e-5  # metres: one rounding of float32 at 0.5 m is 6e-8; the rest allows for another CPU's FMA
ENERGY_DRIFT = 3e-3  # of the largest kinetic energy, in 1 s at 9000 steps/s; the script prints 1.1e-3
HALF_STEP_M = 2e-4  # a fifth of the tracking noise; the script prints 0.3e-4


@pytest.fixture(scope="module")
def sample(repository: Path) -> Path:
    """The sample scene's folder."""
    return repository / "sample" / "soft_beam"


@pytest.fixture(scope="module")
def scene(sample: Path) -> Scene:
    """The sample scene."""
    return read_bundle(sample)


@pytest.fixture(scope="module")
def script(repository: Path) -> ModuleType:
    """The script as a module."""
    path = repository / "scripts" / "make_sample_scene.py"
    specification = importlib.util.spec_from_file_location("make_sample_scene", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules["make_sample_scene"] = module
    specification.loader.exec_module(module)
    return module


def test_it_is_sound_and_small(sample: Path, scene: Scene) -> None:
    assert validate(scene) == ([], [])
    assert sum(path.stat().st_size for path in sample.iterdir()) < 1_000_000


def test_it_has_what_the_demo_needs(scene: Scene) -> None:
    assert scene.points.shape == (90, 80, 3)
    assert (scene.fps, scene.train, scene.test) == (30.0, (0, 63), (63, 90))
    assert scene.initial_state == UNDEFORMED_AT_REST
    assert scene.visible[0].all()
    assert 0.05 < 1.0 - scene.visible.mean() < 0.12
    assert scene.rest_volume_points is not None
    assert len(scene.grips) == 1
    assert scene.noise_sigma_m == 1e-3


def test_its_motion_goes_on_in_the_held_out_frames(scene: Scene) -> None:
    way = np.linalg.norm(scene.controllers[scene.test[1] - 1] - scene.controllers[scene.test[0]], axis=1)
    assert way.min() > 0.05
    table = held_out_table(scene, {})
    floor = table["noise_floor_m"]
    assert table["track_m"]["static"] > 50 * floor
    assert table["track_m"]["rigid_follow"] > 5 * floor
    assert table["track_m"]["constant_velocity"] > 50 * floor


def test_the_grips_points_move_rigidly_with_the_gripper_up_to_noise(scene: Scene, script: ModuleType) -> None:
    recipe = script.Recipe()
    held = np.array(scene.grips[0].points)
    for t in (20, 50, 89):
        moved = script.gripped(recipe, scene.points[0, held], scene.times[t])
        seen = scene.visible[t, held]
        error = np.linalg.norm(moved - scene.points[t, held], axis=1)[seen]
        assert error.mean() < 2.0 * np.sqrt(8 / np.pi) * recipe.noise_sigma_m  # noise of both frames


def test_the_truth_beside_it_is_the_scripts_recipe(sample: Path, script: ModuleType) -> None:
    truth = json.loads((sample / "truth.json").read_text())
    recipe = script.Recipe()
    assert {name: truth[name] for name in ("young_pa", "poisson", "density_kg_m3", "seed")} == {
        "young_pa": recipe.young_pa,
        "poisson": recipe.poisson,
        "density_kg_m3": recipe.density_kg_m3,
        "seed": recipe.seed,
    }


def test_the_mesh_fills_the_box_and_its_mass_is_the_boxs(script: ModuleType) -> None:
    recipe = script.Recipe()
    mesh = script.build_mesh(recipe)
    volume = script.signed_volumes(mesh.vertices, mesh.tetrahedra)
    assert (volume > 0).all()
    assert volume.sum() == pytest.approx(np.prod(recipe.size_m))
    assert mesh.mass.sum() == pytest.approx(recipe.density_kg_m3 * np.prod(recipe.size_m))
    faces = np.sort(mesh.tetrahedra[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    _, shared = np.unique(faces, axis=0, return_counts=True)
    nx, ny, nz = recipe.cells
    assert set(shared) == {1, 2}
    assert (shared == 1).sum() == 4 * (nx * ny + ny * nz + nx * nz)  # two triangles a cell face, both sides


@pytest.mark.slow
def test_the_script_makes_it_again(scene: Scene, script: ModuleType) -> None:
    recipe = script.Recipe()
    mesh = script.build_mesh(recipe)
    again = script.make_scene(recipe, mesh, script.simulate(recipe, mesh)[0])
    assert np.array_equal(again.visible, scene.visible)
    for name in ("points", "controllers", "controller_velocities", "rest_volume_points", "times"):
        assert np.abs(getattr(again, name) - getattr(scene, name)).max() < REGENERATED, name


@pytest.mark.slow
def test_its_physics_can_be_trusted(script: ModuleType) -> None:
    figures = script.check(script.Recipe(), frames=31)
    assert figures["energy_drift"] < ENERGY_DRIFT
    assert figures["half_step_m"] < HALF_STEP_M
