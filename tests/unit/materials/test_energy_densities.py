"""Stored energies of the laws: what every one of them shares at small strain, under rotation and at inversion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physworld.materials.library import ELASTIC_LAWS, SOLID_LAWS, law_class, with_law
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.rod import RodLaw, rod_strains
from physworld.materials.sheet import OrthotropicSheetLaw, SheetLaw, sheet_strains
from physworld.materials.solid import SolidLaw

ISOTROPIC = [name for name in SOLID_LAWS if name != "transversely_isotropic"]
ROUNDING = 1e-12


def law_of(name: str, **values: float) -> SolidLaw:
    return SOLID_LAWS[name](9e4, 0.3, **values)


def gradients(count: int, scale: float = 0.3, seed: int = 0) -> np.ndarray:
    """Deformation gradients with a positive determinant, (count, 3, 3)."""
    turns = Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix()
    stretched = np.eye(3) + np.random.default_rng(seed + 1).uniform(-scale, scale, (count, 3, 3))
    return turns @ stretched


@pytest.mark.parametrize("name", SOLID_LAWS)
def test_every_law_is_linear_elasticity_at_small_strain(name: str) -> None:
    law = law_of(name)
    mu, lam = law.lame
    strain = np.random.default_rng(2).normal(size=(8, 3, 3))
    strain = 0.5 * (strain + strain.transpose(0, 2, 1)) * 1e-4
    linear = mu * np.sum(strain**2, axis=(1, 2)) + 0.5 * lam * np.trace(strain, axis1=1, axis2=2) ** 2
    assert law.energy_density(np.eye(3) + strain) == pytest.approx(linear, rel=2e-3)


@pytest.mark.parametrize("name", SOLID_LAWS)
def test_energy_ignores_rotation_in_space(name: str) -> None:
    law = law_of(name, **({"fibre_modulus_pa": 5e4} if name == "transversely_isotropic" else {}))
    F = gradients(8)
    turn = Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix()
    assert law.energy_density(turn @ F) == pytest.approx(law.energy_density(F), rel=1e-9)
    assert np.all(law.energy_density(F) > 0)


@pytest.mark.parametrize("name", ISOTROPIC)
def test_energy_of_an_isotropic_law_ignores_rotation_of_the_material(name: str) -> None:
    law, F = law_of(name), gradients(8)
    turn = Rotation.from_rotvec([0.3, 1.1, -2.0]).as_matrix()
    assert law.energy_density(F @ turn) == pytest.approx(law.energy_density(F), rel=1e-9)


def test_fibres_stiffen_the_direction_they_run_in() -> None:
    law = SOLID_LAWS["transversely_isotropic"](9e4, 0.0, fibre_modulus_pa=3e5, fibre_azimuth_rad=np.pi / 2)
    plain = NeoHookean(9e4, 0.0)
    for axis, extra in ((0, 0.0), (1, 3e5), (2, 0.0)):
        F = np.eye(3)
        F[axis, axis] += 1e-3
        added = law.energy_density(F) - plain.energy_density(F)
        assert added == pytest.approx(0.5 * extra * 1e-6, rel=2e-3, abs=1e-9)


@pytest.mark.parametrize("name", SOLID_LAWS)
def test_energy_is_infinite_inside_out_only_where_the_law_says_so(name: str) -> None:
    inside_out = law_of(name).energy_density(np.diag([1.0, 1.0, -0.5]))
    assert np.isinf(inside_out) == SOLID_LAWS[name].stress.infinite_at_inversion


def test_an_orthotropic_sheet_with_ratios_of_one_is_the_isotropic_one() -> None:
    rng = np.random.default_rng(3)
    strain, curvature = rng.normal(size=(2, 10, 3))
    plain = SheetLaw(80.0, 2e-3, 0.25).energy_density(strain, curvature)
    woven = OrthotropicSheetLaw(80.0, 2e-3, 0.25).energy_density(strain, curvature)
    assert woven == pytest.approx(plain, rel=ROUNDING)


def test_warp_weft_and_shear_of_cloth_have_their_own_stiffness() -> None:
    law = OrthotropicSheetLaw(80.0, 2e-3, 0.25, weft_ratio=0.5, shear_ratio=0.1, bending_weft_ratio=0.25)
    none, one = np.zeros(3), np.eye(3) * 0.01
    energies = np.array([law.energy_density(s, none) for s in one])
    assert energies == pytest.approx(0.5 * 80.0 * 1e-4 * np.array([1.0, 0.5, 2 * 0.75 * 0.1]), rel=ROUNDING)
    bends = np.array([law.energy_density(none, k) for k in one])
    assert bends == pytest.approx(0.5 * 2e-3 * 1e-4 * np.array([1.0, 0.25, 2 * 0.75]), rel=ROUNDING)


def test_strains_of_a_cylinder_and_of_a_ring() -> None:
    radius = 0.2
    cylinder = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1 / radius], [0, 0, 0], [0, 0, 0]])
    strain, curvature = sheet_strains(cylinder)
    assert strain == pytest.approx(np.zeros(3)) and curvature == pytest.approx([1 / radius, 0, 0])
    stretch, bend = rod_strains(np.array([[1.1, 0.0, 0.0], [0.0, 1.21 / radius, 0.0]]))
    assert stretch == pytest.approx(0.1) and bend == pytest.approx([0, 0, 1 / radius])
    assert RodLaw(10.0, 0.4).energy_density(stretch, bend) == pytest.approx(0.05 + 0.2 / radius**2)


def test_a_law_changes_its_name_and_keeps_its_numbers() -> None:
    law = NeoHookean(2e5, 0.2, viscosity_pa_s=3.0, density_kg_m3=400.0)
    other = with_law(law, "hencky")
    assert type(other).name == "hencky" and with_law(other, "neo_hookean") == law
    assert type(with_law(SheetLaw(80.0, 2e-3), "orthotropic_sheet")) is ELASTIC_LAWS["orthotropic_sheet"]
    with pytest.raises(ValueError, match="no law 'hencky' for a body of dimension 2"):
        law_class("hencky", 2)
