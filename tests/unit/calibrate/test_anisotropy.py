"""Constants of anisotropic laws: found where planted, held where the data do not ask, and a law chosen by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene, recorded_by

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.calibrate.fibres import angles_of, directions
from physworld.calibrate.law_choice import cross_validate
from physworld.materials.library import with_law
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

SIZE = np.array([0.14, 0.07, 0.03])
MODULUS_PA, FIBRES_PA, AZIMUTH_RAD = 4e4, 6e4, 0.6
ISOTROPIC, FIBRED = "neo_hookean", "transversely_isotropic"
CONFIG = CalibrationConfig(particle_budget=100, damping="none")


def shaken_block(frames: int = 30) -> Scene:
    """A flat block that droops from the clamp at its end, which shakes it sideways and up."""
    grip = np.array([[0.0, y, z] for y in (0.01, 0.06) for z in (0.005, 0.025)])
    points = [[x, y, 0.03] for x in np.linspace(0.04, 0.14, 6) for y in (0.0, 0.035, 0.07)]
    scene = made_scene(
        points, "beam", grip, frames, body=box_body([0, 0, 0], SIZE, density_kg_m3=1000.0),
        grips=(Grip((0, 1, 2, 3), np.zeros(3), np.array([0.03, 0.07, 0.03])),), initial_state=UNDEFORMED_AT_REST,
    )  # fmt: skip
    t = scene.times
    early = t < 0.8
    shake = np.stack([0 * t, 0.012 * np.sin(14 * t) * early, 0.006 * np.sin(9 * t) * early], axis=1)
    return replace(scene, controllers=scene.controllers + shake[:, None])


def recorded(fibres: float, budget: int, refinement: float = 1.0, sigma: float = 2e-4) -> Scene:
    """The block as our engine moves it, with fibres of this modulus [Pa] at the planted azimuth."""
    scene = shaken_block()
    twin = build_twin(scene, budget, "cpu", refinement)
    twin = replace(twin, law=with_law(twin.law, FIBRED)).with_parameters(
        youngs_modulus_pa=MODULUS_PA, fibre_modulus_pa=fibres, fibre_azimuth_rad=AZIMUTH_RAD
    )
    return recorded_by(twin, scene, sigma)


@pytest.mark.slow
def test_fibres_are_recovered_from_another_resolution() -> None:
    scene = recorded(FIBRES_PA, 400, 1.5)
    found = calibrate(scene, replace(CONFIG, particle_budget=400, law=FIBRED)).parameters
    assert found["fibre_modulus_pa"].value == pytest.approx(FIBRES_PA, rel=0.05)
    assert found["youngs_modulus_pa"].value == pytest.approx(MODULUS_PA, rel=0.05)
    assert found["fibre_azimuth_rad"].value == pytest.approx(AZIMUTH_RAD, abs=0.05)
    assert found["fibre_elevation_rad"].value == pytest.approx(0.0, abs=0.15)
    assert all(found[name].identified for name in ("fibre_modulus_pa", "fibre_azimuth_rad"))
    low, high = found["fibre_modulus_pa"].ci95
    assert low < FIBRES_PA < high


def test_an_isotropic_body_has_no_fibres() -> None:
    found = calibrate(recorded(0.0, 100), replace(CONFIG, law=FIBRED)).parameters
    fibres = found["fibre_modulus_pa"]
    assert fibres.value == 0.0 and not fibres.identified and "not needed" in fibres.note
    assert "fibre_azimuth_rad" not in found
    assert found["youngs_modulus_pa"].value == pytest.approx(MODULUS_PA, rel=0.02)


@pytest.mark.slow
def test_cross_validation_takes_fibres_where_there_are_some() -> None:
    choice = cross_validate(recorded(FIBRES_PA, 100), CONFIG, (ISOTROPIC, FIBRED))
    errors = {name: score["mean"] for name, score in choice.figures["held_out_rms_m"].items()}
    assert choice.elastic == FIBRED and errors[FIBRED] < 0.5 * errors[ISOTROPIC]
    assert choice.figures["needless_constants"] == {}


@pytest.mark.slow
def test_cross_validation_takes_none_where_there_are_none() -> None:
    choice = cross_validate(recorded(0.0, 100), CONFIG, (ISOTROPIC, FIBRED))
    assert choice.elastic == ISOTROPIC
    assert choice.figures["needless_constants"][FIBRED]["fibre_modulus_pa"] < 0.1


def test_directions_are_all_around() -> None:
    vectors = directions()
    assert len(vectors) == 13 and np.allclose(np.linalg.norm(vectors, axis=1), 1.0)
    assert np.abs(vectors @ vectors.T - np.eye(13)).max() < 0.83  # no two alike, none opposite
    random = np.random.default_rng(0).normal(size=(200, 3))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    assert np.abs(random @ vectors.T).max(axis=1).min() > np.cos(0.6)
    for vector in vectors:
        azimuth, elevation = angles_of(vector)
        level = np.cos(elevation)
        back = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
        np.testing.assert_allclose(back, vector, atol=1e-12)
