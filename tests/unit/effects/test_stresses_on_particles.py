"""Stresses of effects on particles whose deformation is given, against their formulas in numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from effect_twins import TWINS

from physworld.devices import default_device
from physworld.effects.base import Effect
from physworld.effects.registry import effect
from physworld.engine.problem import Problem
from physworld.engine.updated.formulation import UpdatedLagrangian

SINGLE = 2e-5
"""Strains and stresses are single precision."""
STEP = 1e-3
VOIGT = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)]
TWIN = replace(TWINS["solid"], ground_height_m=None, formulation="updated_lagrangian")


class Stressed:
    """The stress that an effect adds to particles, substep by substep."""

    def __init__(self, added: Effect) -> None:
        problem = Problem(TWIN.lattice, TWIN.law, TWIN.body.rest, TWIN.gravity_m_s2)
        self.engine = UpdatedLagrangian(added.problem(problem, TWIN))
        self.count = len(self.engine.solid)
        self.clock = wp.array([0.1, 1.0 / STEP, STEP], dtype=wp.float64, device=default_device())
        self.substep = 0
        self.engine.terms.begin(np.array([0.0, 0.1]), np.zeros((self.count, 3)))

    def at(self, F: np.ndarray, before: float = 0.0) -> np.ndarray:
        """Kirchhoff stress [Pa] (P, 6) that is added to ``before`` at deformations ``F`` (P, 3, 3)."""
        room = -(-self.count // 8) * 8
        whole = np.tile(np.eye(3), (room, 1, 1))
        whole[: self.count] = F
        stress = wp.full(6 * room, before, dtype=wp.float32, device=default_device())
        counter = wp.array([0, self.substep, 100], dtype=wp.int32, device=default_device())
        none = wp.zeros(3 * self.count, dtype=wp.float32, device=default_device())
        self.engine.terms.launch(none, none, wp.array(whole, dtype=wp.mat33d), stress, self.clock, counter)
        self.substep += 1
        return stress.numpy().reshape(-1, 6)[: self.count] / self.engine.volume[:, None]


def deformations(count: int, seed: int = 0) -> np.ndarray:
    return np.eye(3) + 0.1 * np.random.default_rng(seed).normal(size=(count, 3, 3))


def green(F: np.ndarray) -> np.ndarray:
    return 0.5 * (F.transpose(0, 2, 1) @ F - np.eye(3))


def kirchhoff(F: np.ndarray, S: np.ndarray) -> np.ndarray:
    tau = F @ S @ F.transpose(0, 2, 1)
    return np.stack([tau[:, i, j] for i, j in VOIGT], axis=1)


def same(found: np.ndarray, expected: np.ndarray) -> None:
    assert np.abs(found - expected).max() < SINGLE * np.abs(expected).max()


def test_fibres_pull_along_themselves() -> None:
    added = effect("anisotropy", ratio=3.0, azimuth_rad=0.4, elevation_rad=-0.3)
    state = Stressed(added)
    F, f = (
        deformations(state.count),
        np.array([np.cos(-0.3) * np.cos(0.4), np.cos(-0.3) * np.sin(0.4), np.sin(-0.3)]),
    )
    along = np.einsum("i,pij,j->p", f, green(F), f)
    S = 3.0 * TWIN.law.youngs_modulus_pa * along[:, None, None] * np.outer(f, f)
    same(state.at(F), kirchhoff(F, S))


def test_a_material_stiffens_with_the_square_of_its_strain() -> None:
    state = Stressed(effect("strain_stiffening", coefficient=20.0))
    F = deformations(state.count)
    E = green(F)
    S = 20.0 * TWIN.law.youngs_modulus_pa * np.einsum("pij,pij->p", E, E)[:, None, None] * E
    same(state.at(F), kirchhoff(F, S))


def test_a_maxwell_branch_fades_with_its_time() -> None:
    """Strain that is put on at once and held: the deviator decays as (tau / (tau + dt))^n, about exp(-t / tau)."""
    state = Stressed(effect("viscoelastic_maxwell", shear_modulus_pa=1e4, relaxation_s=0.02))
    rest, F = np.tile(np.eye(3), (state.count, 1, 1)), deformations(state.count)
    assert np.abs(state.at(rest)).max() == 0.0
    E = green(F)
    for n in range(1, 6):
        S = 2e4 * E * (0.02 / (0.02 + STEP)) ** n
        S -= np.trace(S, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
        same(state.at(F), kirchhoff(F, S))


def test_a_bent_rest_shape_is_a_stress_of_the_undeformed_bar() -> None:
    state = Stressed(effect("rest_shape", curvature_2_per_m=2.0))
    places = TWIN.lattice.particle_coordinates
    filled = TWIN.lattice.particle_measures > 0
    strain = -2.0 * (places - places[filled].mean(axis=0))[filled, 2]
    mu, lam = TWIN.law.lame
    expected = np.zeros((state.count, 6))
    expected[:, :3] = -lam * strain[:, None]
    expected[:, 0] -= 2 * mu * strain
    same(state.at(np.tile(np.eye(3), (state.count, 1, 1))), expected)


def test_what_yields_keeps_its_deviator_on_the_yield_surface() -> None:
    """Beside the neo-Hookean law: |dev tau| = sqrt(2/3) Y for every deformation that yields."""
    yields = 0.05 * TWIN.law.youngs_modulus_pa
    state = Stressed(effect("plasticity", inverse_yield_per_pa=1.0 / yields))
    F = deformations(state.count)
    for share in np.linspace(0.0, 1.0, 81):  # small steps: the return is exact to first order
        plastic = state.at(np.eye(3) + share * (F - np.eye(3)))
    b = F @ F.transpose(0, 2, 1)
    law = TWIN.law.lame[0] * (b - np.eye(3))
    total = plastic + np.stack([law[:, i, j] for i, j in VOIGT], axis=1)
    deviator = total.copy()
    deviator[:, :3] -= deviator[:, :3].mean(axis=1, keepdims=True)
    size = np.sqrt((deviator[:, :3] ** 2).sum(axis=1) + 2 * (deviator[:, 3:] ** 2).sum(axis=1))
    trial = law - np.trace(law, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    beyond = np.sqrt((trial**2).sum(axis=(1, 2))) > np.sqrt(2 / 3) * yields
    assert beyond.mean() > 0.5
    assert size[beyond] == pytest.approx(np.sqrt(2 / 3) * yields, rel=0.03)
    assert np.abs(plastic[~beyond]).max(initial=0.0) < SINGLE * yields


def test_stiffness_that_grows_multiplies_the_stress_of_the_substep() -> None:
    state = Stressed(effect("time_varying_stiffness", log_rate_per_s=0.5))
    state.substep = 40
    grown = state.at(np.tile(np.eye(3), (state.count, 1, 1)), before=1e-3) * state.engine.volume[:, None]
    same(grown, np.full_like(grown, 1e-3 * np.exp(0.5 * 40 * STEP)))
