"""Return mappings against a numpy oracle, and what each law promises."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from physworld.devices import default_device
from physworld.engine.updated.stress import ParticleStress, padded
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.plastic import DruckerPrager, Identity, Plasticity, StVenantKirchhoff, VonMises

LAW = NeoHookean(1e5, 0.3)
MU, LAM = LAW.lame
DT = 1e-3
COUNT = 300
ROUNDING = 2e-8  # strains are double precision, the moduli single


def mapped(
    law: Plasticity, F: np.ndarray, memory: np.ndarray | None = None, dt: float = DT
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(F, Kirchhoff stress, memory) after the return mapping of trial gradients (P, 3, 3)."""
    count = len(F)
    stress = ParticleStress(LAW, law, np.ones(count), np.ones(count), default_device())
    if memory is not None:
        stress.memory.assign(memory)
    room = padded(count)
    F_d = wp.array(
        np.concatenate([F, np.tile(np.eye(3), (room - count, 1, 1))]),
        dtype=wp.mat33d,
        device=default_device(),
    )
    C = wp.zeros(9 * room, dtype=wp.float32, device=default_device())
    out = wp.zeros(6 * count, dtype=wp.float32, device=default_device())
    flags = wp.zeros(4, dtype=wp.int32, device=default_device())
    clock = wp.array([DT, 1.0 / dt, dt], dtype=wp.float64, device=default_device())
    stress.launch(F_d, C, out, clock, flags)
    assert not flags.numpy().any()
    xx, yy, zz, yz, xz, xy = out.numpy().reshape(-1, 6).T
    tau = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    return F_d.numpy()[:count], tau, stress.memory.numpy()


def gradients(scale: float, seed: int = 0, volume: float = 1.0) -> np.ndarray:
    """Rotated random stretches with ``scale`` of strain and determinant ``volume`` on average, (P, 3, 3)."""
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))[:, None, None]
    return volume ** (1 / 3) * rotation @ (np.eye(3) + scale * rng.normal(size=(COUNT, 3, 3)))


def hencky(F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(trace, deviatoric norm) of the Hencky strain and the tensor itself, by numpy's SVD."""
    U, s, _ = np.linalg.svd(F)
    logs = np.log(s)
    strain = np.einsum("pik,pk,pjk->pij", U, logs, U)
    deviator = logs - logs.mean(axis=1, keepdims=True)
    return logs.sum(axis=1), np.linalg.norm(deviator, axis=1), strain


def oracle(F: np.ndarray, kept: np.ndarray, trace: np.ndarray) -> np.ndarray:
    """F with the deviator of its Hencky strain times ``kept`` and another trace."""
    U, s, Vt = np.linalg.svd(F)
    logs = np.log(s)
    deviator = logs - logs.mean(axis=1, keepdims=True)
    new = kept[:, None] * deviator + trace[:, None] / 3
    return np.einsum("pik,pk,pkj->pij", U, np.exp(new), Vt)


def test_the_elastic_stress_is_st_venant_kirchhoff_in_hencky_strain() -> None:
    F = gradients(0.1)
    new, tau, _ = mapped(Identity(), F)
    trace, _, strain = hencky(F)
    expected = 2 * MU * strain + LAM * trace[:, None, None] * np.eye(3)
    assert np.array_equal(new, F)
    assert np.abs(tau - expected).max() < 1e-6 * np.abs(expected).max()


def test_von_mises_ends_on_its_yield_surface_with_its_volume_and_directions() -> None:
    law = VonMises(yield_stress_pa=4e3, hardening_pa=2e4)
    F = gradients(0.1)
    memory = np.random.default_rng(1).uniform(0, 0.1, COUNT)
    trace, size, _ = hencky(F)
    new, _, after = mapped(law, F, memory)
    root = np.sqrt(2 / 3)
    excess = 2 * MU * size - root * (4e3 + 2e4 * memory)
    slip = np.maximum(excess, 0) / (2 * MU + 2 / 3 * 2e4)
    assert (excess > 0).mean() > 0.9
    assert np.abs(new - oracle(F, 1 - slip / size, trace)).max() < ROUNDING
    new_trace, new_size, _ = hencky(new)
    assert np.abs(2 * MU * new_size - root * (4e3 + 2e4 * after))[excess > 0].max() < 1e-6 * 4e3
    assert np.abs(new_trace - trace).max() < ROUNDING
    assert np.abs(after - memory - root * slip).max() < ROUNDING


def test_von_mises_yields_in_simple_tension_at_its_yield_stress() -> None:
    law = VonMises(yield_stress_pa=4e3)
    axial = 4e3 / LAW.youngs_modulus_pa
    lateral = -LAW.poissons_ratio * axial
    for factor, yields in ((0.999, False), (1.001, True)):
        F = np.diag(np.exp(factor * np.array([axial, lateral, lateral])))[None]
        new, _, _ = mapped(law, F)
        assert np.array_equal(new, F) != yields


@pytest.mark.parametrize(
    "law", [VonMises(1e5), StVenantKirchhoff(1e5, 10.0), StVenantKirchhoff(), DruckerPrager(1.4)]
)
def test_nothing_changes_inside_the_yield_surface(law: Plasticity) -> None:
    F = gradients(1e-3, volume=0.97)
    new, _, memory = mapped(law, F)
    assert np.array_equal(new, F)
    assert not memory.any()


def test_viscous_flow_decays_to_the_yield_surface_at_its_rate() -> None:
    law, steps, dt = StVenantKirchhoff(yield_stress_pa=3e3, flow_viscosity_pa_s=800.0), 50, 1e-5
    F = gradients(0.1, seed=3)
    surface = np.sqrt(2 / 3) * 3e3
    trace, size, _ = hencky(F)
    first = 2 * MU * size - surface
    new = F
    for _ in range(steps):
        new, _, _ = mapped(law, new, dt=dt)
    new_trace, new_size, _ = hencky(new)
    left = 2 * MU * new_size - surface
    flowing = first > 0
    expected = first * (1 + 2 * MU * dt / 800.0) ** -steps
    assert np.abs(left - expected)[flowing].max() < 1e-6 * first.max()
    assert expected[flowing] == pytest.approx(first[flowing] * np.exp(-2 * MU * dt * steps / 800.0), rel=0.03)
    assert np.abs(new_trace - trace).max() < ROUNDING


def test_without_viscosity_st_venant_kirchhoff_is_von_mises() -> None:
    F = gradients(0.1)
    assert np.abs(mapped(StVenantKirchhoff(4e3), F)[0] - mapped(VonMises(4e3), F)[0]).max() < ROUNDING


def test_grains_end_on_the_cone_or_in_its_tip() -> None:
    law = DruckerPrager(friction_angle_rad=np.radians(35.0))
    F = gradients(0.05, volume=0.93)
    trace, size, _ = hencky(F)
    new, tau, memory = mapped(law, F)
    new_trace, new_size, _ = hencky(new)
    open_ = trace >= 0
    factor = law.cone_slope * (3 * LAM + 2 * MU) / (2 * MU)
    slides = ~open_ & (size + factor * trace > 0)
    assert open_.any() and slides.any() and (~open_ & ~slides).any()
    assert np.abs(tau[open_]).max() < 1e-6 * MU
    assert memory[open_] == pytest.approx(trace[open_])
    kept = np.where(slides, -factor * trace / size, 1.0)
    assert np.abs(new - oracle(F, np.where(open_, 0, kept), np.where(open_, 0, trace))).max() < ROUNDING
    assert np.abs(new_size + factor * new_trace)[slides].max() < ROUNDING


def test_the_cone_is_that_of_the_friction_angle_in_triaxial_compression() -> None:
    """Drucker and Prager's cone through the compressive corners: sin phi = (s3 - s1) / (s3 + s1) of the stresses."""
    angle = np.radians(35.0)
    F = np.diag(np.exp([-0.3, 0.06, 0.06]))[None]
    _, tau, _ = mapped(DruckerPrager(angle), F)
    most, least = -tau[0, 0, 0], -tau[0, 1, 1]
    assert (most - least) / (most + least) == pytest.approx(np.sin(angle), rel=1e-4)


def test_cohesion_moves_the_tip_to_c_over_tan_phi() -> None:
    angle, cohesion = np.radians(30.0), 500.0
    _, tau, _ = mapped(DruckerPrager(angle, cohesion), 1.05 * np.eye(3)[None])
    assert tau[0] == pytest.approx(cohesion / np.tan(angle) * np.eye(3), abs=1e-2)


def test_grains_that_opened_must_close_before_they_press() -> None:
    law, memory = DruckerPrager(np.radians(30.0)), None
    F = np.eye(3)[None]
    for stretch in (1.02, 1.03):
        F, _, memory = mapped(law, stretch * F, memory)
    F, tau, memory = mapped(law, F / 1.03, memory)
    assert np.abs(tau).max() < 1e-6 * MU
    F, tau, memory = mapped(law, F / 1.03, memory)
    assert memory[0] == 0.0
    assert hencky(F)[0][0] == pytest.approx(3 * np.log(1.02 / 1.03), abs=ROUNDING)


@pytest.mark.parametrize(
    "make",
    [
        lambda: VonMises(-1.0),
        lambda: StVenantKirchhoff(1.0, -1.0),
        lambda: DruckerPrager(0.0),
        lambda: DruckerPrager(0.5, -2.0),
    ],
)
def test_numbers_without_meaning_are_refused(make: object) -> None:
    with pytest.raises(ValueError, match="got"):
        make()  # type: ignore[operator]
