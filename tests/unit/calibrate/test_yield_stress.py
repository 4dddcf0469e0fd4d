"""Calibration of a flow law: a planted yield stress is found, and none where the body is elastic."""

from __future__ import annotations

import pytest
from made_scene import recorded_by
from test_global_stage import CONFIG, SIGMA_M, YOUNGS_MODULUS_PA, shaken_bar

from physworld.calibrate import CalibrationConfig, FitResult, calibrate
from physworld.calibrate.parameters import flow_law
from physworld.materials.plastic import VonMises
from physworld.scene import Scene
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

YIELD_STRESS_PA = 700.0
FLOWING = CalibrationConfig(particle_budget=CONFIG.particle_budget, plasticity="von_mises")


def recorded(yield_stress_pa: float) -> Scene:
    scene = shaken_bar()
    twin = build_twin(scene, CONFIG.particle_budget, plasticity=VonMises(yield_stress_pa))
    return recorded_by(twin.with_parameters(youngs_modulus_pa=YOUNGS_MODULUS_PA), scene, SIGMA_M, seed=1)


def covered(fitted: FitResult, name: str, truth: float) -> bool:
    low, high = fitted.parameters[name].ci95 or (float("nan"), float("nan"))
    return low <= truth <= high


def test_a_planted_yield_stress_is_found_with_the_stiffness() -> None:
    fitted = calibrate(recorded(YIELD_STRESS_PA), FLOWING)
    assert fitted.twin.formulation == "updated_lagrangian"
    assert fitted.parameters["yield_stress_pa"].value == pytest.approx(YIELD_STRESS_PA, rel=0.02)
    assert covered(fitted, "yield_stress_pa", YIELD_STRESS_PA)
    assert fitted.parameters["youngs_modulus_pa"].value == pytest.approx(YOUNGS_MODULUS_PA, rel=0.03)
    assert fitted.losses["rms_over_noise"] < 1.1


def test_where_nothing_flows_the_yield_stress_is_not_needed() -> None:
    fitted = calibrate(recorded(1e9), FLOWING)
    estimate = fitted.parameters["yield_stress_pa"]
    assert not estimate.identified and "not needed" in estimate.note
    assert fitted.parameters["youngs_modulus_pa"].value == pytest.approx(YOUNGS_MODULUS_PA, rel=0.03)


def test_an_unknown_flow_law_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"no flow law 'creep'; there are .*von_mises"):
        flow_law("creep")
