"""The native kernels against plain numpy: forces are minus the derivative of the stored energy."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from bodies import rest_nodes
from scipy.spatial.transform import Rotation

from physworld.devices import default_device
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.total.forces import InternalForces
from physworld.materials.laws import Law
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import OrthotropicSheetLaw, SheetLaw
from physworld.materials.solid import SolidLaw

SINGLE_PRECISION = 3e-5  # solids carry strains in float32; relative to the largest nodal force
DOUBLE_DIFFERENCE = 2e-6  # central differences of the energy in float64

SOLID = NeoHookean(9e4, 0.33, density_kg_m3=800.0)
SHEET = SheetLaw(120.0, 2e-4, 0.3)
CLOTH = OrthotropicSheetLaw(
    120.0, 2e-4, 0.2, weft_ratio=0.6, shear_ratio=0.1, bending_weft_ratio=0.5, bending_twist_ratio=0.3,
    bending_coupling=-1.4,
)  # fmt: skip
HINGED = SheetLaw(120.0, 2e-4, 0.3, bending_twist_ratio=2.9, bending_coupling=-0.5)
ROD = RodLaw(90.0, 3e-3)
BODIES = {
    "solid": (box_lattice(np.zeros(3), np.array([0.2, 0.05, 0.04]), (5, 2, 1)), SOLID),
    "sheet": (box_lattice(np.zeros(2), np.array([0.2, 0.15]), (5, 4)), SHEET),
    "hinged sheet": (box_lattice(np.zeros(2), np.array([0.2, 0.15]), (5, 4)), HINGED),
    "cloth": (box_lattice(np.zeros(2), np.array([0.2, 0.15]), (5, 4)), CLOTH),
    "rod": (box_lattice(np.zeros(1), np.array([0.4]), (9,)), ROD),
}


def forces_of(
    lattice: Lattice, law: Law, x: np.ndarray, viscous_from: np.ndarray | None = None
) -> np.ndarray:
    forces = InternalForces(lattice, law, np.ones(lattice.fill.size), rest_nodes(lattice), default_device())
    clock = wp.zeros(3, dtype=wp.float64)
    out = wp.zeros(x.size, dtype=wp.float64)
    if viscous_from is not None:
        forces.launch(wp.array(viscous_from.reshape(-1), dtype=wp.float64), clock, out)
        out.zero_()
        clock.assign(np.array([0.0, 1e3, 1e-3]))
    forces.launch(wp.array(x.reshape(-1), dtype=wp.float64), clock, out)
    return out.numpy().reshape(-1, 3)


def energy(lattice: Lattice, law: Law, x: np.ndarray) -> float:
    """Stored energy [J] written from the docstrings of the kernels."""

    def at(*orders: int) -> np.ndarray:
        return lattice.interpolation(lattice.particle_coordinates, orders) @ x

    measure = lattice.particle_measures
    if isinstance(law, SolidLaw):
        mu, lam = law.lame
        F = np.stack([at(1, 0, 0), at(0, 1, 0), at(0, 0, 1)], axis=-1)
        log_j = np.log(np.linalg.det(F))
        density = 0.5 * mu * (np.sum(F**2, axis=(1, 2)) - 3 - 2 * log_j) + 0.5 * lam * log_j**2
    elif isinstance(law, SheetLaw):
        a1, a2 = at(1, 0), at(0, 1)
        normal = np.cross(a1, a2)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        e = [0.5 * (np.sum(a1 * a1, 1) - 1), 0.5 * (np.sum(a2 * a2, 1) - 1), 0.5 * np.sum(a1 * a2, 1)]
        k = [np.sum(normal * at(*o), 1) for o in ((2, 0), (0, 2), (1, 1))]
        nu = law.poissons_ratio

        def form(s: list[np.ndarray], weft: float, shear: float, coupling: float) -> np.ndarray:
            both = 2 * nu * coupling * np.sqrt(weft) * s[0] * s[1]
            return s[0] ** 2 + weft * s[1] ** 2 + both + 2 * (1 - nu) * shear * s[2] ** 2

        woven = isinstance(law, OrthotropicSheetLaw)
        stretch = (law.weft_ratio, law.shear_ratio) if woven else (1.0, 1.0)
        weft = law.bending_weft_ratio if woven else 1.0
        density = 0.5 * law.membrane_n_m * form(e, *stretch, 1.0)
        density += 0.5 * law.bending_n_m * form(k, weft, law.bending_twist_ratio, law.bending_coupling)
    else:
        t, c = at(1), at(2)
        length = np.linalg.norm(t, axis=1)
        curvature = np.linalg.norm(np.cross(t, c), axis=1) / length**3
        density = 0.5 * law.stretching_n * (length - 1) ** 2 + 0.5 * law.bending_n_m2 * curvature**2
    return float(np.sum(measure * density))


def deformed(lattice: Lattice, seed: int = 1) -> np.ndarray:
    """A smooth deformation of some percent strain and much rotation, away from the origin."""
    rng = np.random.default_rng(seed)
    x = rest_nodes(lattice)
    bend = 0.04 * np.sin(9 * x[:, :1] + rng.uniform(0, 3, 3)) + 0.03 * x[:, :1] * rng.normal(size=3)
    x = x + bend + rng.normal(scale=2e-4, size=x.shape)
    return Rotation.from_rotvec([0.4, -0.9, 0.6]).apply(x) + np.array([0.7, -1.2, 2.0])


@pytest.mark.parametrize("name", BODIES)
def test_force_is_minus_the_derivative_of_the_energy(name: str) -> None:
    lattice, law = BODIES[name]
    x = deformed(lattice)
    force = forces_of(lattice, law, x)
    step = 1e-6
    rng = np.random.default_rng(2)
    for node in rng.choice(len(x), size=min(12, len(x)), replace=False):
        for axis in range(3):
            probe = np.zeros_like(x)
            probe[node, axis] = step
            slope = (energy(lattice, law, x + probe) - energy(lattice, law, x - probe)) / (2 * step)
            tolerance = SINGLE_PRECISION if name == "solid" else DOUBLE_DIFFERENCE
            assert abs(force[node, axis] + slope) < tolerance * np.abs(force).max()


@pytest.mark.parametrize("name", BODIES)
def test_forces_turn_with_the_body_and_ignore_its_place(name: str) -> None:
    lattice, law = BODIES[name]
    x = deformed(lattice)
    turn = Rotation.from_rotvec([1.1, 0.2, -2.0])
    turned = forces_of(lattice, law, turn.apply(x) + np.array([3.0, -2.0, 5.0]))
    expected = turn.apply(forces_of(lattice, law, x))
    assert np.abs(turned - expected).max() < SINGLE_PRECISION * np.abs(expected).max()


@pytest.mark.parametrize("name", BODIES)
def test_internal_forces_carry_no_momentum_and_no_angular_momentum(name: str) -> None:
    lattice, law = BODIES[name]
    x = deformed(lattice)
    force = forces_of(lattice, law, x)
    scale = np.abs(force).sum()
    assert np.abs(force.sum(axis=0)).max() < 1e-6 * scale
    assert np.abs(np.cross(x - x.mean(axis=0), force).sum(axis=0)).max() < 1e-5 * scale * np.ptp(x)


@pytest.mark.parametrize("name", BODIES)
def test_the_undeformed_body_carries_no_force(name: str) -> None:
    lattice, law = BODIES[name]
    rest = rest_nodes(lattice)
    loaded = np.abs(forces_of(lattice, law, deformed(lattice))).max()
    assert np.abs(forces_of(lattice, law, rest)).max() < SINGLE_PRECISION * loaded


@pytest.mark.parametrize(
    ("name", "law"),
    [
        ("solid", NeoHookean(9e4, 0.33, viscosity_pa_s=30.0)),
        ("sheet", SheetLaw(120.0, 2e-4, 0.3, relaxation_s=2e-3)),
        ("rod", RodLaw(90.0, 3e-3, relaxation_s=2e-3)),
    ],
)
def test_internal_friction_dissipates_and_leaves_rigid_motion_alone(name: str, law: Law) -> None:
    lattice, elastic = BODIES[name]
    x, dt = deformed(lattice), 1e-3
    friction = forces_of(lattice, law, x, viscous_from=x) - forces_of(lattice, elastic, x)
    assert np.abs(friction).max() < SINGLE_PRECISION * np.abs(forces_of(lattice, elastic, x)).max()

    spin = Rotation.from_rotvec(np.array([0.3, -0.2, 0.5]) * 1e-4)
    turned = spin.apply(x)
    rigid = forces_of(lattice, law, turned, viscous_from=x) - forces_of(lattice, elastic, turned)
    rng = np.random.default_rng(3)
    step = rng.normal(scale=1e-6, size=x.shape)
    moved = x + step
    shaken = forces_of(lattice, law, moved, viscous_from=x) - forces_of(lattice, elastic, moved)
    power = float(np.sum(shaken * step / dt))
    assert power < 0
    rigid_power = float(np.sum(rigid * (turned - x) / dt))
    assert abs(rigid_power) < 2e-3 * abs(power) * np.sum((turned - x) ** 2) / np.sum(step**2)


def test_a_particle_without_material_never_stops_a_run() -> None:
    lattice = box_lattice(np.zeros(3), np.array([0.1, 0.05, 0.05]), (2, 1, 1))
    lattice.fill[0, 0] = 0.0
    forces = InternalForces(lattice, SOLID, np.ones(lattice.fill.size), rest_nodes(lattice), default_device())
    x = rest_nodes(lattice)
    out = wp.zeros(x.size, dtype=wp.float64)
    forces.launch(wp.array((-x).reshape(-1), dtype=wp.float64), wp.zeros(3, dtype=wp.float64), out)
    assert forces.inverted.numpy()[0] == 1  # the filled particles are inside out
    assert np.isfinite(out.numpy()).all()


def test_a_law_of_another_dimension_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fit a lattice of dimension 3"):
        InternalForces(BODIES["solid"][0], ROD, np.ones(80), rest_nodes(BODIES["solid"][0]), default_device())
