"""Every solid's law on particles: Kirchhoff stress is the derivative of its energy, and F advances with C."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from physworld.devices import default_device
from physworld.engine.updated.stress import ParticleStress, padded
from physworld.materials.library import SOLID_LAWS

COUNT = 21  # not a multiple of the lanes
SINGLE = 2e-5  # stresses are single precision, of strains of a tenth


def launched(
    stress: ParticleStress, F: np.ndarray, C: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(F, stress tensors times volume, volume ratios) after one launch; F and C are (P, 3, 3)."""
    room = padded(len(F))
    full_F, full_C = np.repeat(np.eye(3)[None], room, axis=0), np.zeros((room, 3, 3))
    full_F[: len(F)], full_C[: len(C)] = F, C
    F_d = wp.array(full_F, dtype=wp.mat33d, device=default_device())
    C_d = wp.array(full_C.reshape(-1).astype(np.float32), dtype=wp.float32, device=default_device())
    out = wp.zeros(6 * room, dtype=wp.float32, device=default_device())
    flags = wp.zeros(4, dtype=wp.int32, device=default_device())
    stress.launch(F_d, C_d, out, wp.array([dt, 1 / dt, dt], dtype=wp.float64, device=default_device()), flags)
    assert not flags.numpy().any()
    xx, yy, zz, yz, xz, xy = out.numpy().reshape(-1, 6)[: len(F)].T
    tau = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    return F_d.numpy()[: len(F)], tau, stress.ratio.numpy()[: len(F)]


@pytest.mark.parametrize("name", sorted(SOLID_LAWS))
def test_the_stress_of_every_law_is_the_derivative_of_its_energy(name: str) -> None:
    law = SOLID_LAWS[name](1e4, poissons_ratio=0.3)
    rng = np.random.default_rng(0)
    F = np.eye(3) + 0.1 * rng.normal(size=(COUNT, 3, 3))
    volume = rng.uniform(0.5, 2.0, COUNT)
    _, tau, ratio = launched(
        ParticleStress(law, None, volume, np.ones(COUNT), default_device()), F, np.zeros_like(F), 1e-12
    )
    step, P = 1e-6, np.empty_like(F)
    for i in range(3):
        for j in range(3):
            E = np.zeros((3, 3))
            E[i, j] = step
            P[:, i, j] = (law.energy_density(F + E) - law.energy_density(F - E)) / (2 * step)
    expected = volume[:, None, None] * P @ F.transpose(0, 2, 1)
    assert np.abs(tau - expected).max() < SINGLE * np.abs(expected).max() + 1e-5 * 1e4
    assert np.abs(ratio - np.linalg.det(F)).max() < 1e-5


def test_the_deformation_gradient_advances_with_the_velocity_gradient_and_friction_follows_it() -> None:
    law = SOLID_LAWS["neo_hookean"](1e-3, poissons_ratio=0.3, viscosity_pa_s=7.0)
    rng = np.random.default_rng(1)
    F = np.eye(3) + 0.1 * rng.normal(size=(COUNT, 3, 3))
    C = rng.normal(size=(COUNT, 3, 3)).astype(np.float32).astype(float)
    new, tau, _ = launched(
        ParticleStress(law, None, np.ones(COUNT), np.ones(COUNT), default_device()), F, C, 1e-3
    )
    assert np.abs(new - (np.eye(3) + 1e-3 * C) @ F).max() < 1e-14
    J = np.linalg.det(new)[:, None, None]
    assert np.abs(tau - 7.0 * J * (C + C.transpose(0, 2, 1))).max() < 1e-2
