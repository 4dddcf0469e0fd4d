"""Every law of solids: its native stress against energies and closed forms written here, and against the axioms."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import material_point, rest_nodes, run
from homogeneous import REST, inverts, mean_stress, nodal_forces
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from physworld.engine.lattice.lattice import box_lattice
from physworld.errors import UnstableSimulation
from physworld.materials.library import SOLID_LAWS
from physworld.materials.solid import SolidLaw

SINGLE_PRECISION = 1e-5  # of the modulus: strains are float32
ISOTROPIC = [name for name in SOLID_LAWS if name != "transversely_isotropic"]
FIBRES = {"fibre_modulus_pa": 2e5, "fibre_azimuth_rad": 0.4, "fibre_elevation_rad": -0.7}


def law_of(name: str) -> SolidLaw:
    return SOLID_LAWS[name](9e4, 0.33, **(FIBRES if name == "transversely_isotropic" else {}))


def energy(law: SolidLaw, F: np.ndarray) -> float:
    """Stored energy [J/m^3], in principal stretches."""
    mu, lam = law.lame
    stretches = np.linalg.svd(F, compute_uv=False)
    J = float(np.linalg.det(F))
    logs, green = np.log(stretches), 0.5 * (stretches**2 - 1)
    neo = 0.5 * mu * (np.sum(stretches**2) - 3) - mu * np.log(J) + 0.5 * lam * np.log(J) ** 2
    hencky = mu * np.sum(logs**2) + 0.5 * lam * np.sum(logs) ** 2
    azimuth, elevation = FIBRES["fibre_azimuth_rad"], FIBRES["fibre_elevation_rad"]
    fibre = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return {
        "neo_hookean": neo,
        "fixed_corotated": mu * np.sum((stretches - 1) ** 2) + 0.5 * lam * (J - 1) ** 2,
        "st_venant_kirchhoff": mu * np.sum(green**2) + 0.5 * lam * np.sum(green) ** 2,
        "hencky": hencky,
        "drucker_prager_elastic": hencky,
        "transversely_isotropic": neo + FIBRES["fibre_modulus_pa"] / 8 * (np.sum((F @ fibre) ** 2) - 1) ** 2,
    }[law.name]


def gradient(seed: int, scale: float = 0.25) -> np.ndarray:
    """A deformation gradient of large strain and large rotation."""
    rng = np.random.default_rng(seed)
    return Rotation.random(rng=rng).as_matrix() @ (np.eye(3) + rng.uniform(-scale, scale, (3, 3)))


@pytest.mark.parametrize("name", SOLID_LAWS)
def test_stress_is_the_derivative_of_the_energy(name: str) -> None:
    law, step = law_of(name), 1e-6
    for seed in range(4):
        F, expected = gradient(seed), np.zeros((3, 3))
        for i in range(3):
            for j in range(3):
                probe = np.zeros((3, 3))
                probe[i, j] = step
                expected[i, j] = (energy(law, F + probe) - energy(law, F - probe)) / (2 * step)
        assert np.abs(mean_stress(law, F) - expected).max() < SINGLE_PRECISION * law.youngs_modulus_pa
        assert law.energy_density(F) == pytest.approx(energy(law, F), rel=1e-9)


@pytest.mark.parametrize("name", SOLID_LAWS)
def test_small_strains_meet_hookes_law(name: str) -> None:
    law = SOLID_LAWS[name](9e4, 0.33)
    mu, lam = law.lame
    strain = np.random.default_rng(5).normal(size=(3, 3)) * 1e-3
    strain = 0.5 * (strain + strain.T)
    hooke = 2 * mu * strain + lam * np.trace(strain) * np.eye(3)
    assert np.abs(mean_stress(law, np.eye(3) + strain) - hooke).max() < 0.02 * np.abs(hooke).max()


@pytest.mark.parametrize("name", SOLID_LAWS)
def test_stress_turns_with_the_body(name: str) -> None:
    law, F = law_of(name), gradient(7)
    turn = Rotation.from_rotvec([2.0, -1.0, 0.7]).as_matrix()
    difference = mean_stress(law, turn @ F) - turn @ mean_stress(law, F)
    assert np.abs(difference).max() < SINGLE_PRECISION * law.youngs_modulus_pa


@pytest.mark.parametrize("name", ISOTROPIC)
def test_an_isotropic_law_has_no_direction(name: str) -> None:
    law, F = law_of(name), gradient(8)
    turn = Rotation.from_rotvec([-0.4, 1.9, 0.7]).as_matrix()
    difference = mean_stress(law, F @ turn) - mean_stress(law, F) @ turn
    assert np.abs(difference).max() < SINGLE_PRECISION * law.youngs_modulus_pa


@pytest.mark.parametrize("name", SOLID_LAWS)
def test_forces_and_their_moments_sum_to_nothing(name: str) -> None:
    rng = np.random.default_rng(9)
    x = REST @ gradient(9, 0.15).T + rng.normal(scale=4e-4, size=REST.shape)
    force = nodal_forces(law_of(name), x)
    scale = np.abs(force).sum()
    assert np.abs(force.sum(axis=0)).max() < 1e-7 * scale
    assert np.abs(np.cross(x - x.mean(axis=0), force).sum(axis=0)).max() < 1e-6 * scale * np.ptp(x)


# Cauchy stress of uniaxial tension from (mu, lambda, stretch along, stretch across); across, the stress is zero
UNIAXIAL = {
    "neo_hookean": (
        lambda mu, lam, a, b: mu * (b * b - 1) + lam * np.log(a * b * b),
        lambda mu, lam, a, b: (mu * (a * a - 1) + lam * np.log(a * b * b)) / a,
    ),
    "fixed_corotated": (
        lambda mu, lam, a, b: 2 * mu * (b - 1) + lam * (a * b * b - 1) * a * b,
        lambda mu, lam, a, b: 2 * mu * (a - 1) + lam * (a * b * b - 1) * b * b,
    ),
    "st_venant_kirchhoff": (
        lambda mu, lam, a, b: mu * (b * b - 1) + lam / 2 * (a * a + 2 * b * b - 3),
        lambda mu, lam, a, b: a * (mu * (a * a - 1) + lam / 2 * (a * a + 2 * b * b - 3)),
    ),
    "hencky": (
        lambda mu, lam, a, b: 2 * mu * np.log(b) + lam * np.log(a * b * b),
        lambda mu, lam, a, b: (2 * mu * np.log(a) + lam * np.log(a * b * b)) / a,
    ),
}


@pytest.mark.parametrize("name", UNIAXIAL)
@pytest.mark.parametrize("stretch", [0.8, 1.02, 1.5])
def test_uniaxial_tension_follows_its_closed_form(name: str, stretch: float) -> None:
    law = SOLID_LAWS[name](9e4, 0.3)
    mu, lam = law.lame
    across_of, along_of = UNIAXIAL[name]
    across = brentq(lambda b: across_of(mu, lam, stretch, b), 0.5, 1.5)
    turn = Rotation.from_rotvec([0.5, 0.5, -1.0]).as_matrix()
    P = turn.T @ mean_stress(law, turn @ np.diag([stretch, across, across]))
    expected = np.diag([along_of(mu, lam, stretch, across), 0.0, 0.0])
    assert np.abs(P - expected).max() < SINGLE_PRECISION * law.youngs_modulus_pa


def test_hencky_tension_is_youngs_modulus_times_the_logarithm() -> None:
    law = SOLID_LAWS["hencky"](9e4, 0.3)
    P = mean_stress(law, np.diag([1.4, 1.4**-0.3, 1.4**-0.3]))
    assert P[0, 0] * 1.4 == pytest.approx(9e4 * np.log(1.4), rel=1e-4)


@pytest.mark.parametrize("name", SOLID_LAWS)
def test_inversion_is_reported_where_the_energy_is_infinite(name: str) -> None:
    law = law_of(name)
    flattened, inside_out = np.diag([1.0, 1.0, 0.3]), np.diag([1.0, 1.1, -0.4])
    assert not inverts(law, flattened)
    assert inverts(law, inside_out) == law.stress.infinite_at_inversion


def test_the_corotated_law_pushes_an_inverted_body_back() -> None:
    law = law_of("fixed_corotated")
    turn = Rotation.from_rotvec([1.0, 2.0, 0.3]).as_matrix()
    P = turn.T @ mean_stress(law, turn @ np.diag([1.0, 1.1, -0.4]))
    assert (
        P[2, 2] < -law.youngs_modulus_pa
    )  # along its thinnest axis the body is driven towards a positive stretch
    assert abs(P[0, 1]) < SINGLE_PRECISION * law.youngs_modulus_pa


@pytest.mark.parametrize("angle", [0.5, 2.0, 3.1])
def test_a_turned_corotated_body_carries_no_stress(angle: float) -> None:
    turn = Rotation.from_rotvec(angle * np.array([0.6, 0.0, -0.8])).as_matrix()
    P = mean_stress(law_of("fixed_corotated"), turn)
    assert np.abs(P).max() < SINGLE_PRECISION * 9e4


@pytest.mark.parametrize("name", ["neo_hookean", "hencky"])
def test_a_body_shot_inside_out_stops_the_run_with_a_typed_error(name: str) -> None:
    lattice = box_lattice(np.zeros(3), np.array([0.06, 0.03, 0.03]), (4, 2, 2))
    rest = rest_nodes(lattice)
    velocity = np.zeros_like(rest)
    velocity[:, 0] = -400.0 * (rest[:, 0] - 0.03)
    with pytest.raises(UnstableSimulation, match="inverted or blew up"):
        run(lattice, SOLID_LAWS[name](1e3, 0.3), np.linspace(0, 0.1, 5), velocity=velocity, clamped=False)


@pytest.mark.parametrize("name", SOLID_LAWS)
def test_a_free_body_of_every_law_rings_and_keeps_its_momentum(name: str) -> None:
    lattice = box_lattice(np.zeros(3), np.array([0.08, 0.04, 0.04]), (4, 2, 2))
    rest = rest_nodes(lattice)
    velocity = 8.0 * (rest - rest.mean(axis=0)) * [1.0, -0.5, -0.5] + [0.0, 0.3, 0.0]
    times = np.linspace(0.0, 0.05, 11)
    nodes = run(lattice, law_of(name), times, gravity=np.zeros(3), velocity=velocity, clamped=False)
    middle = material_point(lattice, nodes, (0.04, 0.02, 0.02))
    assert np.abs(middle - middle[0] - np.outer(times, [0.0, 0.3, 0.0])).max() < 1e-5
    end = material_point(lattice, nodes, (0.08, 0.02, 0.02))[:, 0]
    assert np.ptp(end) > 1e-3 and np.any(np.diff(end) < 0)
