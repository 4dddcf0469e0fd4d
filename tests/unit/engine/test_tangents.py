"""The tangents against finite differences of the forces that the time stepping launches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from bodies import rest_nodes
from scipy.spatial.transform import Rotation

from physworld.devices import default_device
from physworld.engine.gradients.tangent import InternalTangent
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.total.forces import InternalForces
from physworld.materials.laws import Law
from physworld.materials.library import SOLID_LAWS
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import OrthotropicSheetLaw, SheetLaw
from physworld.materials.solid import SolidLaw

pytestmark = pytest.mark.slow

TOLERANCE = {3: 1e-3, 2: 1e-6, 1: 1e-6}  # of the largest entry: solids' forces are rounded to float32
STEP = {3: 2e-5, 2: 1e-7, 1: 1e-7}  # [m] of the differences
DT = 2e-4
SHAPES = {
    3: box_lattice(np.zeros(3), np.array([0.12, 0.05, 0.04]), (3, 2, 1)),
    2: box_lattice(np.zeros(2), np.array([0.2, 0.15]), (4, 3)),
    1: box_lattice(np.zeros(1), np.array([0.4]), (9,)),
}
LAWS: dict[str, Law] = {
    **{name: law(9e4, 0.33, viscosity_pa_s=4.0) for name, law in SOLID_LAWS.items()},
    "transversely_isotropic": SOLID_LAWS["transversely_isotropic"](
        9e4, 0.33, viscosity_pa_s=4.0, fibre_modulus_pa=2e5, fibre_azimuth_rad=0.4, fibre_elevation_rad=-0.7
    ),
    "isotropic_sheet": SheetLaw(120.0, 2e-2, 0.3, relaxation_s=5e-4),
    "orthotropic_sheet": OrthotropicSheetLaw(
        120.0,
        2e-2,
        0.3,
        relaxation_s=5e-4,
        weft_ratio=0.6,
        shear_ratio=0.1,
        bending_twist_ratio=0.3,
        bending_coupling=-1.4,
    ),
    "rod": RodLaw(90.0, 3e-3, relaxation_s=5e-4),
}


def shape_of(law: Law) -> Lattice:
    return SHAPES[3 if isinstance(law, SolidLaw) else 2 if isinstance(law, SheetLaw) else 1]


def state(lattice: Lattice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Deformed positions, those of the substep before, and a direction, (n, 3) each."""
    rng = np.random.default_rng(11)
    x = rest_nodes(lattice)
    x = x + 0.01 * np.sin(20 * x[:, :1] + rng.uniform(0, 3, 3)) + rng.normal(scale=5e-4, size=x.shape)
    x = Rotation.from_rotvec([0.4, -0.9, 0.6]).apply(x) + np.array([0.7, -1.2, 2.0])
    before = x - DT * (rng.normal(scale=0.3, size=x.shape) + np.cross([3.0, 1.0, -2.0], x))
    return x, before, rng.normal(size=x.shape)


def upload(values: np.ndarray) -> wp.array:
    return wp.array(values.reshape(-1), dtype=wp.float64)


def forces(law: Law, factor: np.ndarray, x: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """Forces (n, 3) at x; with friction if the positions before are given."""
    lattice = shape_of(law)
    model = InternalForces(lattice, law, factor, rest_nodes(lattice), default_device())
    out, clock = wp.zeros(x.size, dtype=wp.float64), wp.zeros(3, dtype=wp.float64)
    if before is not None:
        model.launch(upload(before), clock, out)
        out.zero_()
        clock = wp.array([0.0, 1 / DT, DT], dtype=wp.float64)
    model.launch(upload(x), clock, out)
    return out.numpy().reshape(-1, 3)


def products(law: Law, friction: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, InternalTangent]:
    """d(w.f)/dx, d(w.f)/dx_previous (n, 3) and d(w.f)/d log p (P, columns) at :func:`state`."""
    lattice = shape_of(law)
    x, before, w = state(lattice)
    tangent = InternalTangent(lattice, law, np.ones(lattice.fill.size), rest_nodes(lattice), default_device())
    out, late = wp.zeros(x.size, dtype=wp.float64), wp.zeros(x.size, dtype=wp.float64)
    columns = len(tangent.parameters)
    parameters = wp.zeros(tangent.particles * columns, dtype=wp.float64)
    if friction:
        clock = wp.array([0.0, 1 / DT, DT], dtype=wp.float64)
        tangent.apply_with_friction(upload(x), upload(before), clock, upload(w), out, late, parameters)
    else:
        tangent.apply(upload(x), upload(w), out, parameters)
    return (
        out.numpy().reshape(-1, 3),
        late.numpy().reshape(-1, 3),
        parameters.numpy().reshape(-1, columns),
        tangent,
    )


@pytest.mark.parametrize("name", LAWS)
def test_the_elastic_product_is_the_derivative_of_the_forces_along_the_direction(name: str) -> None:
    law = LAWS[name]
    lattice = shape_of(law)
    x, _, w = state(lattice)
    ones, step = np.ones(lattice.fill.size), STEP[lattice.dim]
    difference = (forces(law, ones, x + step * w) - forces(law, ones, x - step * w)) / (2 * step)
    out, late, _, _ = products(law, friction=False)
    assert np.abs(out - difference).max() < TOLERANCE[lattice.dim] * np.abs(difference).max()
    assert not late.any()


@pytest.mark.parametrize("name", LAWS)
def test_the_elastic_product_is_symmetric(name: str) -> None:
    law = LAWS[name]
    lattice = shape_of(law)
    x, _, w = state(lattice)
    other = np.random.default_rng(12).normal(size=x.shape)
    tangent = InternalTangent(lattice, law, np.ones(lattice.fill.size), rest_nodes(lattice), default_device())
    out = np.zeros((2, x.size))
    for k, direction in enumerate((w, other)):
        result = wp.zeros(x.size, dtype=wp.float64)
        tangent.apply(upload(x), upload(direction), result)
        out[k] = result.numpy()
    first, second = out[0] @ other.reshape(-1), out[1] @ w.reshape(-1)
    assert first == pytest.approx(second, rel=1e-4)


@pytest.mark.parametrize("name", LAWS)
def test_products_with_friction_are_derivatives_by_both_positions(name: str) -> None:
    law = LAWS[name]
    lattice = shape_of(law)
    x, before, w = state(lattice)
    ones, step = np.ones(lattice.fill.size), STEP[lattice.dim]
    out, late, _, _ = products(law, friction=True)
    rng = np.random.default_rng(13)
    for found, moves in ((out, (1.0, 0.0)), (late, (0.0, 1.0))):
        for _ in range(4):
            probe = rng.normal(size=x.shape)
            work = [
                np.sum(w * forces(law, ones, x + s * moves[0] * probe, before + s * moves[1] * probe))
                for s in (step, -step)
            ]
            slope = (work[0] - work[1]) / (2 * step)
            scale = np.linalg.norm(found) * np.linalg.norm(probe) / np.sqrt(x.size)
            assert abs(np.sum(found * probe) - slope) < 3 * TOLERANCE[lattice.dim] * scale


@pytest.mark.parametrize("name", LAWS)
def test_the_stiffness_columns_are_the_derivative_by_the_stiffness_field(name: str) -> None:
    law = LAWS[name]
    lattice = shape_of(law)
    x, before, w = state(lattice)
    _, _, parameters, tangent = products(law, friction=True)
    found = parameters[:, list(tangent.stiffness_columns)].sum(axis=1)
    step = 0.05
    for particle in (0, lattice.fill.size // 2, lattice.fill.size - 1):
        works = []
        for sign in (1, -1):
            factor = np.ones(lattice.fill.size)
            factor[particle] = np.exp(sign * step)
            works.append(np.sum(w * forces(law, factor, x, before)))
        slope = (works[0] - works[1]) / (2 * np.sinh(step))
        assert abs(found[particle] - slope) < TOLERANCE[lattice.dim] * np.abs(found).max()


@pytest.mark.parametrize("name", LAWS)
def test_the_friction_column_is_the_derivative_by_the_friction(name: str) -> None:
    law = LAWS[name]
    lattice = shape_of(law)
    x, before, w = state(lattice)
    _, _, parameters, tangent = products(law, friction=True)
    field = "viscosity_pa_s" if isinstance(law, SolidLaw) else "relaxation_s"
    ones = np.ones(lattice.fill.size)
    with_it, twice = (
        np.sum(w * forces(replace(law, **{field: k * getattr(law, field)}), ones, x, before)) for k in (1, 2)
    )
    assert parameters[:, -1].sum() == pytest.approx(twice - with_it, rel=20 * TOLERANCE[lattice.dim])
    assert tangent.parameters[-1] in ("viscosity", "relaxation")


@pytest.mark.parametrize("name", SOLID_LAWS)
def test_the_columns_of_the_moduli_give_the_derivative_by_poissons_ratio(name: str) -> None:
    law = replace(LAWS[name], viscosity_pa_s=0.0)
    lattice = shape_of(law)
    x, _, w = state(lattice)
    _, _, parameters, tangent = products(law, friction=False)
    assert not parameters[:, tangent.parameters.index("viscosity")].any()
    step, ones = 1e-2, np.ones(lattice.fill.size)
    high, low = (replace(law, poissons_ratio=law.poissons_ratio + s) for s in (step, -step))
    slope = (np.sum(w * forces(high, ones, x)) - np.sum(w * forces(low, ones, x))) / (2 * step)
    by_log = parameters.sum(axis=0)
    chain = [(h - l) / (2 * step) / m for h, l, m in zip(high.moduli, low.moduli, law.moduli, strict=True)]
    assert np.dot(by_log[: len(chain)], chain) == pytest.approx(slope, rel=2e-3)
