from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from physworld.devices import default_device
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.thin.triangles import Mesh, TriangleLattice, triangle_lattice
from physworld.engine.total.forces import InternalForces
from physworld.engine.total.formulation import TotalLagrangian
from physworld.engine.total.stability import fastest_frequency
from physworld.errors import SceneUnsupported
from physworld.materials.sheet import OrthotropicSheetLaw, SheetLaw

SIZE = np.array([0.3, 0.2])
LAW = SheetLaw(600.0, 2e-3, density_kg_m2=1.2)


def lattice(odd: bool = False) -> TriangleLattice:
    return triangle_lattice(SIZE, Mesh((4, 3), odd), np.array([0.1, -0.2]))


def at_rest(mesh: TriangleLattice) -> np.ndarray:
    return np.column_stack([mesh.node_coordinates, np.zeros(len(mesh.nodes))])


def forces_of(mesh: TriangleLattice, x: np.ndarray, law: SheetLaw = LAW) -> np.ndarray:
    forces = InternalForces(mesh, law, np.ones(mesh.fill.size), at_rest(mesh), default_device())
    found = wp.zeros(x.size, dtype=wp.float64)
    forces.launch(wp.array(x.ravel(), dtype=wp.float64), wp.zeros(3, dtype=wp.float64), found)
    return found.numpy().reshape(x.shape)


def energy(mesh: TriangleLattice, x: np.ndarray) -> float:
    """As the module's text has it, in numpy alone."""
    tangents = np.einsum("tka,tki->tai", mesh.slopes, x[mesh.triangles])
    e = 0.5 * (np.einsum("tai,tbi->tab", tangents, tangents) - np.eye(2))
    strains = np.stack([e[:, 0, 0], e[:, 1, 1], e[:, 0, 1]], axis=1)
    stored = float(mesh.areas @ LAW.energy_density(strains, np.zeros_like(strains)))
    edges, weights, areas = mesh.hinges
    bent = np.einsum("hk,hki->hi", weights, x[edges])
    return stored + float(np.sum(LAW.bending_n_m / (2.0 * areas) * np.sum(bent**2, axis=1)))


@pytest.mark.parametrize("odd", [False, True])
def test_a_linear_field_is_met_everywhere_also_outside(odd: bool) -> None:
    mesh = lattice(odd)
    rng = np.random.default_rng(0)
    places = rng.uniform([0.05, -0.25], [0.45, 0.05], (200, 2))
    slope = np.array([[1.5], [-0.7]])
    field = mesh.node_coordinates @ slope + 2.0
    assert mesh.interpolation(places) @ field == pytest.approx(places @ slope + 2.0)
    assert mesh.interpolation(places, (1, 0)) @ field == pytest.approx(np.full((200, 1), 1.5))
    assert mesh.interpolation(places, (0, 1)) @ field == pytest.approx(np.full((200, 1), -0.7))


@pytest.mark.parametrize("odd", [False, True])
def test_a_place_takes_the_corners_of_its_own_triangle(odd: bool) -> None:
    mesh = lattice(odd)
    middle = mesh.node_coordinates[mesh.triangles].mean(axis=1)
    rows = mesh.interpolation(middle).toarray()
    for row, corners in zip(rows, mesh.triangles, strict=True):
        assert row[corners] == pytest.approx(np.full(3, 1 / 3))
        assert row.sum() == pytest.approx(1.0)


def test_diagonals_alternate_and_triangles_fill_the_sheet() -> None:
    mesh = lattice()
    places = mesh.node_coordinates[mesh.triangles]
    first, second = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    signed = 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    assert signed == pytest.approx(mesh.areas) and signed.sum() == pytest.approx(np.prod(SIZE))
    assert mesh.crossed(np.arange(4)).tolist() == [False, True, False, True]
    assert lattice(odd=True).crossed(np.arange(4)).tolist() == [True, False, True, False]


def test_a_third_of_every_triangle_hangs_at_each_corner() -> None:
    mesh = lattice()
    mass = mesh.lumped(LAW.density_kg_m2 * mesh.particle_measures)
    expected = np.zeros(len(mesh.nodes))
    for corners, area in zip(mesh.triangles, mesh.areas, strict=True):
        expected[corners] += LAW.density_kg_m2 * area / 3
    assert mass == pytest.approx(expected) and mass.sum() == pytest.approx(1.2 * np.prod(SIZE))


@pytest.mark.parametrize("odd", [False, True])
def test_forces_are_the_slope_of_the_energy(odd: bool) -> None:
    mesh = lattice(odd)
    rng = np.random.default_rng(1)
    x = at_rest(mesh) + rng.normal(0.0, 4e-3, (len(mesh.nodes), 3))
    way, step = rng.normal(size=x.shape), 1e-6
    slope = (energy(mesh, x + step * way) - energy(mesh, x - step * way)) / (2 * step)
    assert -np.sum(forces_of(mesh, x) * way) == pytest.approx(slope, rel=1e-6)


def test_a_turned_mesh_has_no_forces_and_a_turn_of_a_bent_one_turns_them() -> None:
    mesh = lattice()
    c, s = np.cos(0.9), np.sin(0.9)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    assert np.abs(forces_of(mesh, at_rest(mesh) @ turn.T)).max() < 1e-10
    bent = at_rest(mesh) + np.random.default_rng(2).normal(0.0, 4e-3, (len(mesh.nodes), 3))
    assert forces_of(mesh, bent @ turn.T) == pytest.approx(forces_of(mesh, bent) @ turn.T, abs=1e-9)


def swing(law: SheetLaw) -> tuple[np.ndarray, TotalLagrangian]:
    mesh = lattice()
    rest = at_rest(mesh)
    x = rest.copy()
    x[:, 2] += 0.4 * (rest[:, 0] - rest[:, 0].mean()) ** 2
    solver = TotalLagrangian(Problem(mesh, law, rest, np.zeros(3)))
    times = np.linspace(0.0, 0.2, 41)
    held = HeldNodes(np.empty(0, dtype=int), np.zeros((41, 0, 3)), np.zeros((41, 0, 3)))
    return solver.run(x, np.zeros_like(x), held, times), solver


def test_a_free_mesh_swings_and_friction_stills_it() -> None:
    plain, solver = swing(LAW)
    rubbed, _ = swing(replace(LAW, relaxation_s=3e-2))

    def speed(nodes: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.diff(nodes[-20:], axis=0) ** 2)))

    assert speed(rubbed) < 0.5 * speed(plain)
    middle = np.einsum("n,tni->ti", solver.mass, plain) / solver.mass.sum()
    assert middle == pytest.approx(np.repeat(middle[:1], 41, axis=0), abs=1e-10)


def test_the_time_step_is_stable_and_its_limit_is_the_fastest_mode() -> None:
    mesh = lattice()
    forces = InternalForces(mesh, LAW, np.ones(mesh.fill.size), at_rest(mesh), default_device())
    mass = mesh.lumped(LAW.density_kg_m2 * mesh.particle_measures)
    found = fastest_frequency(forces, at_rest(mesh), mass, float(mesh.spacing.min()))
    n = len(mass)
    stiffness, step = np.zeros((3 * n, 3 * n)), 1e-6
    for k in range(3 * n):
        push = np.zeros(3 * n)
        push[k] = step
        ahead, behind = (forces_of(mesh, at_rest(mesh) + s * push.reshape(-1, 3)) for s in (1, -1))
        stiffness[:, k] = -(ahead - behind).ravel() / (2 * step)
    exact = np.sqrt(np.linalg.eigvals(stiffness / np.repeat(mass, 3)[:, None]).real.max())
    assert exact <= found <= 1.1 * exact


def test_what_needs_splines_says_so() -> None:
    mesh = lattice()
    with pytest.raises(SceneUnsupported, match="12 cells of a mesh of triangles"):
        mesh.table((1, 0))
    with pytest.raises(SceneUnsupported, match="second derivatives"):
        mesh.interpolation(mesh.particle_coordinates, (2, 0))
    with pytest.raises(ValueError, match="none along a side"):
        triangle_lattice(SIZE, Mesh((0, 3)))


def test_hinges_refuse_what_they_cannot_bend_like_and_threads_are_stretched() -> None:
    mesh = lattice()
    woven = OrthotropicSheetLaw(600.0, 2e-3, density_kg_m2=1.2, weft_ratio=0.5, shear_ratio=0.1)
    stretched = at_rest(mesh) * np.array([1.0, 1.01, 1.0])
    pulls = [np.abs(forces_of(mesh, stretched, law)[:, 1]).max() for law in (LAW, woven)]
    assert pulls[1] == pytest.approx(0.5 * pulls[0], rel=0.05)
    for law in (
        replace(LAW, bending_twist_ratio=3.0),
        replace(LAW, bending_coupling=0.5),
        replace(woven, bending_weft_ratio=0.2),
    ):
        with pytest.raises(SceneUnsupported, match="one bending stiffness"):
            forces_of(mesh, stretched, law)


def test_friction_does_not_feel_a_turn_of_a_bent_sheet() -> None:
    mesh = lattice()
    bent = at_rest(mesh)
    bent[:, 2] += 0.4 * (bent[:, 0] - bent[:, 0].mean()) ** 2
    forces = InternalForces(
        mesh, replace(LAW, relaxation_s=0.1), np.ones(mesh.fill.size), at_rest(mesh), default_device()
    )
    clock = wp.array([0.0, 1e3, 1e-3], dtype=wp.float64)

    def pulls(x: np.ndarray) -> np.ndarray:
        found = wp.zeros(x.size, dtype=wp.float64)
        forces.launch(wp.array(x.ravel(), dtype=wp.float64), clock, found)
        return found.numpy().reshape(x.shape)

    pulls(bent)
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    at_once = pulls(bent @ turn.T)
    assert at_once == pytest.approx(forces_of(mesh, bent @ turn.T), abs=1e-8)
