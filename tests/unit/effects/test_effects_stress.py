"""Stresses of effects: minus the derivative of their energy written in plain numpy, and how they relax, yield, turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from effect_twins import TWINS, loose, moved
from scipy.spatial.transform import Rotation

from physworld.effects.base import Effect
from physworld.effects.registry import effect
from physworld.engine.gradients.gradient import internal_forces
from physworld.engine.problem import Problem
from physworld.engine.terms.term import BoundTerm
from physworld.materials.library import with_law
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

SINGLE_PRECISION = 3e-4  # solids carry strains in float32; relative to the largest nodal force
DOUBLE = 2e-6
TOLERANCE = {"solid": SINGLE_PRECISION, "sheet": DOUBLE, "rope": DOUBLE}
WEIGHT = {3: np.array([1, 1, 1, 2, 2, 2.0]), 2: np.array([1, 1, 2.0])}


class Applied:
    """A term of an effect on a twin, its last by default, driven by hand from the undeformed body."""

    def __init__(self, twin: Twin, added: Effect, number: int = -1) -> None:
        self.twin = twin
        problem = Problem(twin.lattice, twin.law, twin.body.rest, np.zeros(3))
        self.bound: BoundTerm = added.problem(problem, twin).terms[number].bind(problem)
        self.substep = 0

    def __call__(self, x: np.ndarray, dt: float = 0.0) -> np.ndarray:
        """Forces (n, 3) [N] at nodes ``x`` (n, 3), ``dt`` after the last call."""
        flat = wp.array(x.reshape(-1), dtype=wp.float64)
        force = wp.zeros(x.size, dtype=wp.float64)
        clock = wp.array([1.0, 1.0 / dt if dt else 0.0, dt], dtype=wp.float64)
        counter = wp.array([0, self.substep, 1000000], dtype=wp.int32)
        self.bound.launch(flat, flat, clock, counter, force)
        self.substep += 1
        return force.numpy().reshape(-1, 3)


def strains(twin: Twin, x: np.ndarray) -> np.ndarray:
    """Solid: Green strain (P, 6). Sheet: membrane and bending strain (P, 6). Rod: stretch and curvature (P, 4)."""
    lattice = twin.lattice

    def at(*orders: int) -> np.ndarray:
        return lattice.interpolation(lattice.particle_coordinates, orders) @ x

    if lattice.dim == 3:
        F = np.stack([at(1, 0, 0), at(0, 1, 0), at(0, 0, 1)], axis=-1)
        E = 0.5 * (np.einsum("pki,pkj->pij", F, F) - np.eye(3))
        return np.stack([E[:, 0, 0], E[:, 1, 1], E[:, 2, 2], E[:, 1, 2], E[:, 0, 2], E[:, 0, 1]], axis=1)
    if lattice.dim == 2:
        a1, a2 = at(1, 0), at(0, 1)
        n = np.cross(a1, a2)
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        membrane = [0.5 * (np.sum(a1 * a1, 1) - 1), 0.5 * (np.sum(a2 * a2, 1) - 1), 0.5 * np.sum(a1 * a2, 1)]
        return np.stack([*membrane, *(np.sum(n * at(*o), 1) for o in ((2, 0), (0, 2), (1, 1)))], axis=1)
    t, c = at(1), at(2)
    length = np.linalg.norm(t, axis=1, keepdims=True)
    return np.concatenate([length - 1, np.cross(t, c) / length**3], axis=1)


def plate(e: np.ndarray, nu: float) -> np.ndarray:
    """nu (tr e)^2 + (1 - nu) e : e of strains (P, 3)."""
    return nu * (e[:, 0] + e[:, 1]) ** 2 + (1 - nu) * (e**2 @ WEIGHT[2])


def maxwell_energy(twin: Twin, e: np.ndarray) -> np.ndarray:
    law = twin.law
    if twin.lattice.dim == 3:
        e = e - np.outer(e[:, :3].mean(axis=1), [1, 1, 1, 0, 0, 0])
        return 4e3 * (e**2 @ WEIGHT[3])
    if twin.lattice.dim == 2:
        nu = law.poissons_ratio
        return 0.3 * 0.5 * (law.membrane_n_m * plate(e[:, :3], nu) + law.bending_n_m * plate(e[:, 3:], nu))
    return 0.3 * 0.5 * (law.stretching_n * e[:, 0] ** 2 + law.bending_n_m2 * np.sum(e[:, 1:] ** 2, axis=1))


def fibre_energy(twin: Twin, e: np.ndarray) -> np.ndarray:
    law, azimuth, elevation = twin.law, 0.4, 0.7
    if twin.lattice.dim == 3:
        level = np.cos(elevation)
        f = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        E = tensors(e)
        return 0.5 * 1.5 * law.youngs_modulus_pa * np.einsum("i,pij,j->p", f, E, f) ** 2
    f = np.array([np.cos(azimuth) ** 2, np.sin(azimuth) ** 2, 2 * np.cos(azimuth) * np.sin(azimuth)])
    return 0.75 * (law.membrane_n_m * (e[:, :3] @ f) ** 2 + law.bending_n_m * (e[:, 3:] @ f) ** 2)


def stiffening_energy(twin: Twin, e: np.ndarray) -> np.ndarray:
    law, half = twin.law, 0.5 * twin.body.thickness_m
    if twin.lattice.dim == 3:
        return 50.0 / 4 * law.youngs_modulus_pa * (e**2 @ WEIGHT[3]) ** 2
    if twin.lattice.dim == 2:
        bending = law.bending_n_m * half**2 * (e[:, 3:] ** 2 @ WEIGHT[2]) ** 2
        return 12.5 * (law.membrane_n_m * (e[:, :3] ** 2 @ WEIGHT[2]) ** 2 + bending)
    bending = law.bending_n_m2 * (2 * half) ** 2 * np.sum(e[:, 1:] ** 2, axis=1) ** 2
    return 12.5 * (law.stretching_n * e[:, 0] ** 4 + bending)


SPRINGS = {
    "viscoelastic_maxwell": (maxwell_energy, {"relaxation_s": 0.1}),
    "anisotropy": (fibre_energy, {"ratio": 1.5, "azimuth_rad": 0.4}),
    "strain_stiffening": (stiffening_energy, {"coefficient": 50.0}),
}
CASES = [(name, body) for name in SPRINGS for body in TWINS if (name, body) != ("anisotropy", "rope")]


def spring(name: str, body: str) -> Effect:
    values = dict(SPRINGS[name][1])
    if name == "viscoelastic_maxwell":
        values |= {"shear_modulus_pa": 4e3} if body == "solid" else {"share": 0.3}
    if name == "anisotropy" and body == "solid":
        values["elevation_rad"] = 0.7
    return effect(name, **values)


def deformed(twin: Twin, seed: int = 0, size: float = 0.1) -> np.ndarray:
    """The undeformed body, stirred by a share of a cell."""
    rng = np.random.default_rng(seed)
    return twin.body.rest + size * float(twin.lattice.spacing.min()) * rng.normal(size=twin.body.rest.shape)


def slope(twin: Twin, energy: object, x: np.ndarray) -> np.ndarray:
    """Minus the derivative of the energy density's integral at a few coordinates: (k,) and their indices (k, 2)."""
    picks = np.random.default_rng(1).integers(0, x.shape[0], 12)
    measure, step = twin.lattice.particle_measures, 1e-6 * float(twin.lattice.spacing.min())
    found = np.zeros((12, 3))
    for row, node in enumerate(picks):
        for i in range(3):
            sides = []
            for sign in (1, -1):
                y = x.copy()
                y[node, i] += sign * step
                sides.append(float(measure @ energy(y)))
            found[row, i] = -(sides[0] - sides[1]) / (2 * step)
    return found, picks


@pytest.mark.parametrize(("name", "body"), CASES)
def test_forces_are_minus_the_derivative_of_the_energy(name: str, body: str) -> None:
    twin, energy = TWINS[body], SPRINGS[name][0]
    applied = Applied(twin, spring(name, body))
    assert np.abs(applied(twin.body.rest)).max() < 1e-9
    x = deformed(twin)
    forces = applied(x)
    expected, picks = slope(twin, lambda y: energy(twin, strains(twin, y)), x)
    np.testing.assert_allclose(forces[picks], expected, atol=TOLERANCE[body] * np.abs(forces).max())
    assert np.abs(forces.sum(axis=0)).max() < TOLERANCE[body] * np.abs(forces).max()


@pytest.mark.parametrize("body", TWINS)
def test_the_stress_of_a_held_stretched_body_relaxes_exponentially(body: str) -> None:
    twin, tau, dt = TWINS[body], 0.1, 1e-4
    applied = Applied(twin, spring("viscoelastic_maxwell", body))
    applied(twin.body.rest)
    x = deformed(twin)
    first = np.linalg.norm(applied(x, 1e-9))
    left = [np.linalg.norm(applied(x, dt)) / first for _ in range(2000)]
    expected = np.exp(-np.arange(1, 2001) * dt / tau)
    np.testing.assert_allclose(left, expected, rtol=2e-3)


@pytest.mark.parametrize("body", ["solid", "rope"])
def test_a_ladder_of_branches_relaxes_as_its_prony_series(body: str) -> None:
    twin, tau, dt = TWINS[body], 0.01, 1e-4
    ladder = effect("viscoelastic_maxwell", share=0.3, relaxation_s=tau, branches=3)
    applied = [Applied(twin, ladder, number) for number in range(-3, 0)]
    x = deformed(twin)
    for branch in applied:
        branch(twin.body.rest)
    first = np.linalg.norm(sum(branch(x, 1e-9) for branch in applied))
    left = [np.linalg.norm(sum(branch(x, dt) for branch in applied)) / first for _ in range(1000)]
    times = np.arange(1, 1001)[:, None] * dt
    series = np.exp(-times / (tau * 10.0 ** np.arange(3))).mean(axis=1)
    np.testing.assert_allclose(left, series, rtol=4e-3)  # the first branch decays in 100 implicit steps


def test_a_share_of_a_solid_is_that_of_its_shear_modulus() -> None:
    twin = TWINS["solid"]
    x = deformed(twin)
    shear = twin.law.youngs_modulus_pa / (2.0 * (1.0 + twin.law.poissons_ratio))
    forces = []
    for strengths in ({"share": 0.25}, {"shear_modulus_pa": 0.25 * shear}):
        applied = Applied(twin, effect("viscoelastic_maxwell", **strengths))
        applied(twin.body.rest)
        forces.append(applied(x, 1e-9))
    np.testing.assert_allclose(*forces, rtol=0, atol=1e-6 * np.abs(forces[0]).max())


def test_a_relaxed_branch_lets_slow_motion_pass() -> None:
    twin = TWINS["rope"]
    applied = Applied(twin, spring("viscoelastic_maxwell", "rope"))
    applied(twin.body.rest)
    x = deformed(twin)
    whole = np.linalg.norm(Applied(twin, spring("viscoelastic_maxwell", "rope"))(twin.body.rest))
    for share in np.linspace(0.0, 1.0, 1001)[1:]:  # 10 s, a hundred relaxation times
        slow = applied(twin.body.rest + share * (x - twin.body.rest), 1e-2)
    fast = Applied(twin, spring("viscoelastic_maxwell", "rope"))
    fast(twin.body.rest)
    assert whole == 0.0
    assert np.linalg.norm(slow) < 0.03 * np.linalg.norm(fast(x, 1e-6))


def yielding(body: str) -> Effect:
    if body == "solid":
        return effect("plasticity", inverse_yield_per_pa=1 / 2e3, hardening=0.2)
    return effect("plasticity", yield_radius_m=0.5, hardening=0.2)


def tensors(e: np.ndarray) -> np.ndarray:
    """Symmetric tensors (P, 3, 3) of their six numbers."""
    return e[:, [0, 5, 4, 5, 1, 3, 4, 3, 2]].reshape(-1, 3, 3)


def curvature_return(k: np.ndarray, p: np.ndarray, g: np.ndarray, limit: float, weight: np.ndarray) -> tuple:
    """Radial return of curvatures in plain numpy: plastic part (P, 3) and what has flowed (P,)."""
    size = np.sqrt((k - p) ** 2 @ weight)
    flow = np.maximum(size - limit - 0.2 * g, 0.0) / 1.2
    return p + (flow / np.maximum(size, 1e-30))[:, None] * (k - p), g + flow


def finite_return(twin: Twin, x: np.ndarray, B: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radial return of b = F B F^T in plain numpy: B = Cp^-1 (P, 3, 3), of determinant 1."""
    lattice = twin.lattice
    rows = [lattice.interpolation(lattice.particle_coordinates, o) for o in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    F = np.stack([row @ x for row in rows], axis=-1)
    b = F @ B @ F.transpose(0, 2, 1)
    dev = b - np.trace(b, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    size = np.linalg.norm(dev, axis=(1, 2))
    flow = np.maximum(size - np.sqrt(2 / 3) * 2e3 / twin.law.lame[0] - 0.2 * g, 0.0) / 1.2
    inverse = np.linalg.inv(F)
    B = B - (flow / np.maximum(size, 1e-30))[:, None, None] * (inverse @ dev @ inverse.transpose(0, 2, 1))
    return B / np.linalg.det(B)[:, None, None] ** (1 / 3), g + flow


def test_plastic_strain_of_a_solid_follows_the_radial_return_and_stays() -> None:
    twin = TWINS["solid"]
    applied, rest, mu = Applied(twin, yielding("solid")), twin.body.rest, twin.law.lame[0]
    assert np.abs(applied(rest)).max() == 0.0
    far = deformed(twin, size=0.1)
    B, g = np.repeat(np.eye(3)[None], twin.lattice.fill.size, axis=0), np.zeros(twin.lattice.fill.size)
    for share in np.concatenate([np.linspace(0, 1, 41)[1:], np.linspace(1, 0, 41)[1:]]):
        forces = applied(rest + share * (far - rest), 1e-3)
        B, g = finite_return(twin, rest + share * (far - rest), B, g)
    filled = twin.lattice.particle_measures > 0
    assert np.abs(B[filled] - np.eye(3)).max() > 0.05
    plastic = B - np.eye(3)
    expected, picks = slope(
        twin, lambda y: mu * np.sum(plastic * tensors(strains(twin, y)), axis=(1, 2)), rest
    )
    np.testing.assert_allclose(forces[picks], expected, atol=2e-3 * np.abs(forces).max())


@pytest.mark.parametrize("body", ["sheet", "rope"])
def test_plastic_curvature_follows_the_radial_return_and_stays(body: str) -> None:
    """Along a way whose tangents hardly turn, so that a rod's memory need not be carried."""
    twin, rest = TWINS[body], TWINS[body].body.rest
    limit, weight = (2.0, WEIGHT[2]) if body == "sheet" else (1 / 12.0, np.ones(3))
    applied = Applied(twin, effect("plasticity", yield_radius_m=1 / limit, hardening=0.2))
    assert np.abs(applied(rest)).max() == 0.0
    bent = deformed(twin, size=0.02)
    if body == "rope":
        bent = rest + np.array([0.0, 0.0, 0.06]) * (rest[:, :1] - 0.15) ** 2
    p, g = np.zeros((twin.lattice.fill.size, 3)), np.zeros(twin.lattice.fill.size)
    for share in (0.3, 1.0, 0.6, 0.0):
        x = rest + share * (bent - rest)
        forces = applied(x, 1e-3)
        p, g = curvature_return(strains(twin, x)[:, -3:], p, g, limit, weight)

    def energy(y: np.ndarray) -> np.ndarray:
        k, law = strains(twin, y)[:, -3:], twin.law
        if body == "rope":
            return -law.bending_n_m2 * np.sum(p * k, axis=1)
        nu = law.poissons_ratio
        mixed = nu * (p[:, 0] + p[:, 1]) * (k[:, 0] + k[:, 1]) + (1 - nu) * np.sum(p * k * WEIGHT[2], axis=1)
        return -law.bending_n_m * mixed

    assert np.abs(p).max() > 0 and np.abs(forces).max() > 0
    expected, picks = slope(twin, energy, rest)
    np.testing.assert_allclose(forces[picks], expected, atol=2e-3 * np.abs(forces).max())


@pytest.mark.parametrize("name", ["plasticity", "viscoelastic_maxwell", "rest_shape"])
@pytest.mark.parametrize("body", TWINS)
def test_memory_turns_with_the_body(name: str, body: str) -> None:
    """A rope is straight again when it is turned, about an axis across it: it carries no spin about its tangent."""
    twin = TWINS[body]
    if name == "rest_shape":
        added = effect(name, curvature_1_per_m=2.0, curvature_2_per_m=-1.0)
    else:
        added = yielding(body) if name == "plasticity" else spring(name, body)
    applied = Applied(twin, added)
    applied(twin.body.rest)
    x = deformed(twin, size=0.1 if body != "rope" else 0.02)
    applied(x, 1e-3)
    x = twin.body.rest if body == "rope" else x
    forces = applied(x)
    assert np.abs(forces).max() > 0
    for share in np.linspace(0.0, 1.0, 201)[1:]:  # turn, no time passing
        turn = Rotation.from_rotvec(share * np.array([0.0, 1.2, -0.9]))
        turned = applied(turn.apply(x))
    limit = {"solid": 2e-3, "sheet": 1e-9, "rope": 1e-9}[body] * np.abs(forces).max()
    np.testing.assert_allclose(turned, turn.apply(forces), atol=limit)


def stretched(twin: Twin, share: float) -> Twin:
    start = twin.body.start.copy()
    middle = start.mean(axis=0)
    start[:, 0] = middle[0] + (1 + share) * (start[:, 0] - middle[0])
    return replace(twin, body=replace(twin.body, start=start))


def test_a_plastic_bar_does_not_return_to_its_length() -> None:
    twin = loose("solid", youngs_modulus_pa=2e4, poissons_ratio=0.3, viscosity_pa_s=60.0)
    times = np.linspace(0.0, 0.6, 4)
    elastic = moved(stretched(twin, 0.1), times)
    plastic = moved(
        stretched(twin, 0.1).with_effect(effect("plasticity", inverse_yield_per_pa=1 / 400.0)), times
    )
    length = np.ptp(twin.body.rest[:, 0])
    assert np.ptp(elastic[-1, :, 0]) / length - 1 == pytest.approx(0.0, abs=0.003)
    assert 0.04 < np.ptp(plastic[-1, :, 0]) / length - 1 < 0.09


def test_viscosity_damps_the_axial_mode_of_a_bar() -> None:
    """u = cos(pi x / L), nu = 0: amplitude falls at eta k^2 / rho."""
    density, eta = 500.0, 2.0
    twin = loose("solid", youngs_modulus_pa=4e4, poissons_ratio=0.0)
    twin = twin.with_effect(effect("viscosity_kelvin_voigt", viscosity_pa_s=eta))
    low, high = 0.0, 0.16
    mode = np.cos(np.pi * (twin.body.rest[:, 0] - low) / (high - low))
    velocity = np.zeros_like(twin.body.rest)
    velocity[:, 0] = 0.02 * mode
    times = np.linspace(0.0, 0.4, 401)
    mass = Problem(twin.lattice, twin.law, twin.body.rest, np.zeros(3)).nodal_mass()
    amplitude = (moved(twin, times, velocity)[:, :, 0] - twin.body.rest[:, 0]) @ (mass * mode)
    wave = np.pi / (high - low)
    speed = np.sqrt(4e4 / density)
    peaks = np.abs(amplitude)[1:-1][
        (np.abs(amplitude)[1:-1] > np.abs(amplitude)[:-2])
        & (np.abs(amplitude)[1:-1] >= np.abs(amplitude)[2:])
    ]
    rate = -np.log(peaks[-1] / peaks[0]) / ((len(peaks) - 1) * np.pi / (wave * speed))
    assert rate == pytest.approx(eta * wave**2 / density, rel=0.05)


@pytest.mark.parametrize("body", ["sheet", "rope"])
def test_viscosity_of_thin_bodies_adds_to_the_laws_own(body: str) -> None:
    times = np.linspace(0.0, 0.1, 4)
    gravity = (0.0, 0.0, -9.81)
    law = loose(body, gravity, relaxation_s=3e-3)
    both = loose(body, gravity, relaxation_s=1e-3).with_effect(
        effect("viscosity_kelvin_voigt", relaxation_s=2e-3)
    )
    thrown = np.random.default_rng(0).normal(scale=0.05, size=law.body.start.shape)
    np.testing.assert_allclose(moved(both, times, thrown), moved(law, times, thrown), atol=1e-12)


@pytest.mark.parametrize("name", ["solid", "sheet"])
def test_fibres_and_friction_are_told_in_pascals(name: str) -> None:
    twin = loose(name)
    modulus, nu = 2e5, twin.parameters["poissons_ratio"]
    if name == "sheet":
        thickness = twin.body.thickness_m
        twin = twin.with_parameters(membrane_n_m=modulus * thickness / (1 - nu**2))
        tau = effect("viscosity_kelvin_voigt", relaxation_s=0.01).derived(twin)
        assert tau["viscosity_pa_s"] == (pytest.approx(0.01 * modulus / (2 + 4 * nu**2)), "Pa s")
        modulus /= 1 - nu**2
    else:
        twin = twin.with_parameters(youngs_modulus_pa=modulus)
        assert effect("viscosity_kelvin_voigt", viscosity_pa_s=3.0).derived(twin) == {}
    assert effect("anisotropy", ratio=0.5).derived(twin) == {
        "fibre_modulus_pa": (pytest.approx(0.5 * modulus), "Pa")
    }


def woven() -> Twin:
    """A sheet none of whose shape numbers is an isotropic one's."""
    law = with_law(TWINS["sheet"].law, "orthotropic_sheet")
    shape = {"weft_ratio": 2.0, "shear_ratio": 0.3, "bending_weft_ratio": 3.0}
    return replace(TWINS["sheet"], law=law).with_parameters(
        **shape, bending_twist_ratio=2.5, bending_coupling=0.4
    )


def own_forces(twin: Twin, x: np.ndarray) -> np.ndarray:
    """Forces (n, 3) [N] of the law alone."""
    forces = internal_forces(Problem(twin.lattice, twin.law, twin.body.rest, np.zeros(3)))
    out = wp.zeros(x.size, dtype=wp.float64)
    forces.launch(wp.array(x.reshape(-1), dtype=wp.float64), wp.zeros(3, dtype=wp.float64), out)
    return out.numpy().reshape(-1, 3)


def test_a_branch_of_a_woven_sheet_has_the_laws_own_stiffness() -> None:
    twin = woven()
    applied = Applied(twin, effect("viscoelastic_maxwell", share=0.3, relaxation_s=0.1))
    applied(twin.body.rest)
    x = deformed(twin)
    expected = 0.3 * own_forces(twin, x)
    np.testing.assert_allclose(applied(x, 1e-12), expected, atol=1e-9 * np.abs(expected).max())


def test_a_woven_sheet_that_flows_at_once_bends_without_a_moment() -> None:
    twin = woven().with_parameters(membrane_n_m=1e-12)
    applied = Applied(twin, effect("plasticity", yield_radius_m=1e12))
    applied(twin.body.rest)
    x = deformed(twin)
    elastic = own_forces(twin, x)
    np.testing.assert_allclose(applied(x, 1e-3), -elastic, atol=1e-6 * np.abs(elastic).max())


def test_a_woven_sheet_is_without_moment_in_its_bent_rest_shape() -> None:
    twin, bend = woven(), np.array([2.0, -1.0, 0.0])
    c11, c22, c12, _ = twin.law.bending_shape
    x = deformed(twin)
    forces = Applied(twin, effect("rest_shape", curvature_1_per_m=2.0, curvature_2_per_m=-1.0))(x)
    moment = twin.law.bending_n_m * np.array([c11 * bend[0] + c12 * bend[1], c22 * bend[1] + c12 * bend[0]])
    expected, picks = slope(twin, lambda y: -strains(twin, y)[:, 3:5] @ moment, x)
    np.testing.assert_allclose(forces[picks], expected, atol=TOLERANCE["sheet"] * np.abs(forces).max())
