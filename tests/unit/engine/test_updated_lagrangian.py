"""The updated Lagrangian form: conservation, closed forms of contact and flight, plastic flow, and typed errors."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from bodies import GRAVITY, NeoHookean, RodLaw, clamped_lattice, material_point, rest_nodes, still_clamp

from physworld.engine.lattice.lattice import Lattice, box_lattice, lattice_from_cells
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.contact import GroundContact
from physworld.engine.total.formulation import TotalLagrangian
from physworld.engine.updated import formulation as updated_lagrangian
from physworld.engine.updated.formulation import UpdatedLagrangian
from physworld.engine.updated.transfer import Apic, Asflip, Transfer
from physworld.errors import CFLViolation, ParticlesLeftTheGrid, SceneUnsupported, UnstableSimulation
from physworld.materials.plastic import DruckerPrager, Identity, VonMises

pytestmark = pytest.mark.slow

SINGLE = 2e-6  # velocities and the grid are single precision


def block(counts: tuple[int, int, int] = (4, 2, 2), cell: float = 0.025) -> Lattice:
    return box_lattice(np.zeros(3), np.array(counts) * cell, counts)


def unheld(frames: int) -> HeldNodes:
    return HeldNodes(np.zeros(0, dtype=int), *np.zeros((2, frames, 0, 3)))


def momenta(engine: UpdatedLagrangian, run: object) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Linear and angular momentum of particles with their affine fields (Jiang et al. 2015), and their scales."""
    q = run.particles  # type: ignore[attr-defined]
    x, v = q.x.numpy().reshape(-1, 3), q.v.numpy().reshape(-1, 3).astype(float)
    spin = q.C.numpy().reshape(-1, 3, 3)[: len(x)].astype(float) * engine.grid.spacing**2 / 4
    curl = np.stack(
        [spin[:, 2, 1] - spin[:, 1, 2], spin[:, 0, 2] - spin[:, 2, 0], spin[:, 1, 0] - spin[:, 0, 1]], axis=1
    )
    mass, moment = engine.mass[:, None], np.cross(x, v)
    return (
        (mass * v).sum(axis=0),
        (mass * (moment + curl)).sum(axis=0),
        float((mass * np.abs(v)).sum()),
        float((mass * np.abs(moment)).sum()),
    )


@pytest.mark.parametrize("transfer", [Apic(), Asflip()], ids=["apic", "asflip"])
def test_momentum_of_a_free_body_is_conserved_to_round_off(transfer: Transfer) -> None:
    lattice = block()
    rest = rest_nodes(lattice)
    velocity = np.random.default_rng(0).normal(scale=0.2, size=rest.shape) + np.array([0.5, 0.0, 0.0])
    problem = Problem(lattice, NeoHookean(5e4, 0.3, 5.0), rest, np.zeros(3))
    engine = UpdatedLagrangian(problem, transfer=transfer)
    run = engine.prepare(rest, velocity, unheld(3))
    before = momenta(engine, run)
    run.record(np.linspace(0.0, 0.1, 3), None)
    after = momenta(engine, run)
    assert np.abs(after[0] - before[0]).max() < SINGLE * before[2]
    if transfer == Apic():  # what FLIP keeps of a velocity does not carry the angular momentum
        assert np.abs(after[1] - before[1]).max() < SINGLE * before[3]


def test_free_fall_is_exact() -> None:
    lattice = block()
    rest = rest_nodes(lattice)
    engine = UpdatedLagrangian(Problem(lattice, NeoHookean(5e4, 0.3), rest, GRAVITY))
    times = np.linspace(0.0, 0.5, 6)
    start = np.tile([1.0, 0.0, 2.0], (len(rest), 1))
    fallen = engine.run_particles(rest, start, unheld(6), times)
    moved = fallen - fallen[0]
    dt = times[-1] / engine.substeps
    expected = np.outer(times, [1.0, 0.0, 2.0]) + np.outer(0.5 * times * (times + dt), GRAVITY)
    assert np.abs(moved - expected[:, None]).max() < 1e-5 * np.abs(expected).max()


def test_a_small_swing_has_the_frequency_of_the_total_lagrangian_form() -> None:
    """The two agree on stiffness and mass; the transfers damp the one and not the other."""
    law = NeoHookean(2e6, 0.0, density_kg_m3=600.0)
    lattice = clamped_lattice(0.3, (0.045, 0.045), (20, 3, 3))
    rest, times = rest_nodes(lattice), np.arange(0.0, 0.25, 0.0025)
    held = still_clamp(lattice, rest, len(times))
    tips = []
    for form in (TotalLagrangian, UpdatedLagrangian):
        nodes = form(Problem(lattice, law, rest, 0.2 * GRAVITY)).run(rest, np.zeros_like(rest), held, times)
        tips.append(material_point(lattice, nodes, (0.3, 0.0225, 0.0225))[:, 2] - 0.0225)
    spectra = [np.abs(np.fft.rfft(tip - tip.mean(), 4096)) for tip in tips]
    peaks = [int(np.argmax(spectrum)) for spectrum in spectra]
    assert peaks[1] == pytest.approx(peaks[0], rel=0.05)
    assert tips[1].min() == pytest.approx(tips[0].min(), rel=0.08)


def test_a_grip_carries_material_as_its_nodes_say() -> None:
    law = NeoHookean(2e5, 0.3, viscosity_pa_s=20.0)
    lattice = clamped_lattice(0.1, (0.05, 0.05), (4, 2, 2))
    rest, times = rest_nodes(lattice), np.linspace(0.0, 0.5, 26)
    held = still_clamp(lattice, rest, len(times))
    angle = 0.5 * np.sin(np.pi * times / 0.5 - np.pi / 2) + 0.5  # a slow turn about z, and a lift
    turn = np.zeros((len(times), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1] = np.cos(angle), -np.sin(angle)
    turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = np.sin(angle), np.cos(angle), 1.0
    paths = np.einsum("tij,nj->tni", turn, rest[held.nodes])
    paths[..., 2] += 0.1 * angle[:, None]
    held = HeldNodes(held.nodes, paths, np.gradient(paths, times, axis=0))
    engine = UpdatedLagrangian(Problem(lattice, law, rest, np.zeros(3), drag_per_s=5.0))
    particles = engine.run_particles(rest, np.zeros_like(rest), held, times)
    whole = np.einsum("tij,pj->tpi", turn, particles[0]) + np.outer(0.1 * angle, [0, 0, 1])[:, None]
    gripped = lattice.particle_coordinates[:, 0] < 0
    assert np.abs(particles - whole)[:, gripped].max() < 1e-9
    assert np.abs(particles - whole)[-1].max() < 0.004  # the rest follows, within its swing


@pytest.mark.parametrize("transfer", [Apic(), Asflip()], ids=["apic", "asflip"])
def test_a_block_slides_to_the_coulomb_distance_and_rests_without_a_gap(transfer: Transfer) -> None:
    law = NeoHookean(2e5, 0.3, viscosity_pa_s=20.0, density_kg_m3=500.0)
    lattice = box_lattice(np.zeros(3), np.array([0.12, 0.12, 0.06]), (4, 4, 2))
    friction, speed = 0.4, 0.8
    rest = rest_nodes(lattice)
    problem = Problem(lattice, law, rest, GRAVITY, terms=(GroundContact(0.0, friction),))
    engine = UpdatedLagrangian(problem, transfer=transfer)
    velocity = np.tile([speed, 0.0, 0.0], (len(rest), 1))
    middle = engine.run_particles(rest, velocity, unheld(4), np.linspace(0.0, 0.6, 4)).mean(axis=1)
    assert middle[-1, 0] - middle[0, 0] == pytest.approx(speed**2 / (2 * friction * 9.81), rel=0.02)
    assert abs(middle[-1, 2] - middle[0, 2]) < 5e-4
    dropped = engine.run_particles(
        rest + np.array([0, 0, 0.005]), 0 * velocity, unheld(4), np.linspace(0.0, 0.6, 4)
    )
    assert abs(dropped[-1].mean(axis=0)[2] - middle[0, 2]) < 5e-4
    assert np.abs(dropped[-1] - dropped[-2]).max() < 1e-5


def test_two_parts_feel_one_another_within_one_and_a_half_cells_and_do_not_pass() -> None:
    """Self-contact through the grid: one lattice, two blocks, no bond between them."""
    upper = np.array([[i, j, k] for i in range(2) for j in range(2) for k in (4, 5)])
    lower = upper - [0, 0, 4]
    cell = 0.02
    cells = np.concatenate([lower, upper])
    lattice = lattice_from_cells(np.zeros(3), np.full(3, cell), cells, np.ones((len(cells), 8)))
    rest, times = rest_nodes(lattice), np.linspace(0.0, 0.4, 41)
    is_upper = lattice.particle_coordinates[:, 2] > 3.5 * cell
    law = NeoHookean(1e5, 0.3, viscosity_pa_s=20.0)
    held_nodes = np.unique(lattice.cell_nodes[lattice.cells[:, 2] == 0])
    held = HeldNodes(
        held_nodes, np.repeat(rest[held_nodes][None], 41, axis=0), np.zeros((41, len(held_nodes), 3))
    )
    engine = UpdatedLagrangian(Problem(lattice, law, rest, GRAVITY))
    z = engine.run_particles(rest, np.zeros_like(rest), held, times)[..., 2]
    gap = z[:, is_upper].min(axis=1) - z[:, ~is_upper].max(axis=1) - 2 * 0.2113 * cell
    assert gap[0] == pytest.approx(2 * cell, rel=0.01)
    assert 0.0 < gap[-1] < 1.6 * cell
    assert abs(gap[-1] - gap[-10]) < 0.05 * cell


def sand(angle_deg: float, transfer: Transfer) -> tuple[np.ndarray, np.ndarray]:
    """Particles of a collapsed column at the end, and the last tenth of a second's motion."""
    lattice = box_lattice(np.array([-0.05, -0.05, 0.0]), np.array([0.1, 0.1, 0.1]), (5, 5, 5))
    law = NeoHookean(2e5, 0.3, density_kg_m3=1500.0)
    ground = GroundContact(0.0, 0.6)
    rest = rest_nodes(lattice)
    engine = UpdatedLagrangian(
        Problem(lattice, law, rest, GRAVITY, terms=(ground,)),
        transfer=transfer,
        plasticity=DruckerPrager(np.radians(angle_deg)),
    )
    path = engine.run_particles(rest, np.zeros_like(rest), unheld(3), np.array([0.0, 0.5, 0.6]))
    return path[-1], path[-1] - path[-2]


def slope_deg(particles: np.ndarray) -> float:
    """Slope of the heap's surface between a third and all of the radius that holds most grains."""
    radius = np.hypot(particles[:, 0], particles[:, 1])
    edges = np.linspace(0.3, 1.0, 8) * np.quantile(radius, 0.97)
    tops = [particles[(radius >= a) & (radius < b), 2].max() for a, b in pairwise(edges)]
    return float(-np.degrees(np.arctan(np.polyfit(0.5 * (edges[1:] + edges[:-1]), tops, 1)[0])))


def test_a_column_of_sand_collapses_to_a_heap_that_its_friction_angle_holds() -> None:
    """A column that collapses ends below the angle of repose, by what it gained in the fall (Lube et al. 2004)."""
    slopes = {}
    for angle in (20.0, 40.0):
        heap, late = sand(angle, Apic())
        assert np.abs(late).max() < 5e-3
        assert heap[:, 2].min() > -1e-4
        slopes[angle] = slope_deg(heap)
        assert 0.4 * angle < slopes[angle] < angle
    assert slopes[40.0] > slopes[20.0] + 5.0


def test_a_von_mises_bar_keeps_its_bend_and_an_elastic_one_does_not() -> None:
    law = NeoHookean(3e5, 0.3, viscosity_pa_s=50.0, density_kg_m3=1000.0)
    lattice = clamped_lattice(0.16, (0.04, 0.04), (8, 2, 2))
    rest = rest_nodes(lattice)
    times = np.linspace(0.0, 0.6, 31)
    first = still_clamp(lattice, rest, len(times))
    last = np.unique(lattice.cell_nodes[lattice.cells[:, 0] == lattice.cells[:, 0].max()])
    down = 0.04 * np.clip(times / 0.2, 0, 1)
    pushed = np.repeat(rest[last][None], len(times), axis=0) - down[:, None, None] * np.array([0, 0, 1.0])
    both = np.concatenate([first.nodes, last])
    paths = np.concatenate([first.positions, pushed], axis=1)
    held = HeldNodes(both, paths, np.gradient(paths, times, axis=0))
    ends = {}
    for name, law_of_flow in (("elastic", Identity()), ("plastic", VonMises(6e3))):
        engine = UpdatedLagrangian(
            Problem(lattice, law, rest, np.zeros(3), drag_per_s=20.0), plasticity=law_of_flow
        )
        run = engine.prepare(rest, np.zeros_like(rest), held)
        run.record(times, None)
        run = run.released(still_clamp(lattice, rest, 2))
        ends[name] = run.record(np.array([0.0, 0.6]), None)[-1]
    tip = lattice.particle_coordinates[:, 0] > 0.14
    sag = {
        name: float(lattice.particle_coordinates[tip, 2].mean() - end[tip, 2].mean())
        for name, end in ends.items()
    }
    assert abs(sag["elastic"]) < 0.008
    assert 0.012 < sag["plastic"] < 0.04


def test_the_grid_follows_a_body_that_travels_far() -> None:
    lattice = block((2, 2, 2))
    rest = rest_nodes(lattice)
    engine = UpdatedLagrangian(Problem(lattice, NeoHookean(1e5, 0.3), rest, np.zeros(3)))
    velocity = np.tile([6.0, -4.0, 0.0], (len(rest), 1))
    path = engine.run_particles(rest, velocity, unheld(2), np.array([0.0, 1.0]))
    assert np.abs(path[1] - path[0] - [6.0, -4.0, 0.0]).max() < 1e-4


def test_a_time_step_above_the_stable_limit_is_refused_with_its_numbers() -> None:
    lattice = block()
    problem = Problem(lattice, NeoHookean(1e5, 0.3), rest_nodes(lattice), GRAVITY)
    limit = UpdatedLagrangian(problem).time_step_s / updated_lagrangian._SAFETY
    with pytest.raises(CFLViolation, match=r"exceeds the stable .* s of pressure waves at .* m/s"):
        UpdatedLagrangian(problem, time_step_s=1.01 * limit)
    stiff = replace(problem, stiffness_factor=np.full(lattice.fill.size, 4.0))
    assert UpdatedLagrangian(stiff).time_step_s == pytest.approx(UpdatedLagrangian(problem).time_step_s / 2)


def test_a_run_just_below_the_limit_stays_stable() -> None:
    lattice = block((6, 3, 3))
    rest = rest_nodes(lattice)
    problem = Problem(lattice, NeoHookean(1e5, 0.3), rest, np.zeros(3))
    limit = UpdatedLagrangian(problem).time_step_s / updated_lagrangian._SAFETY
    velocity = np.random.default_rng(2).normal(scale=0.05, size=rest.shape)
    engine = UpdatedLagrangian(problem, time_step_s=0.95 * limit)
    path = engine.run_particles(rest, velocity, unheld(2), np.array([0.0, 1.0]))
    assert np.ptp(path[1], axis=0) == pytest.approx(np.ptp(path[0], axis=0), rel=0.2)


def test_particles_that_cross_a_cell_in_a_substep_are_refused_with_their_numbers() -> None:
    lattice = block((2, 2, 2))
    rest = rest_nodes(lattice)
    engine = UpdatedLagrangian(Problem(lattice, NeoHookean(1e5, 0.3), rest, np.zeros(3)))
    engine.crossing_limit = 10.0  # no smaller step for fast particles
    with pytest.raises(CFLViolation, match=r"crossed 2\.\d+ cells of 0\.025 m in one substep"):
        engine.run_particles(rest, np.tile([60.0, 0, 0], (len(rest), 1)), unheld(2), np.array([0.0, 0.2]))


def test_grains_that_scatter_too_far_are_refused_with_their_numbers() -> None:
    lattice = block((2, 2, 2))
    rest = rest_nodes(lattice)
    engine = UpdatedLagrangian(
        Problem(lattice, NeoHookean(1e4, 0.3), rest, np.zeros(3)), plasticity=DruckerPrager(0.5)
    )
    velocity = 4000.0 * (rest - rest.mean(axis=0))
    with pytest.raises(ParticlesLeftTheGrid, match="grid nodes, more than"):
        engine.run_particles(rest, velocity, unheld(2), np.array([0.0, 10.0]))


def test_states_that_are_not_finite_are_refused_with_their_numbers() -> None:
    lattice = block((2, 2, 2))
    rest = rest_nodes(lattice)
    engine = UpdatedLagrangian(Problem(lattice, NeoHookean(1e5, 0.3), rest, np.zeros(3)))
    velocity = np.zeros_like(rest)
    velocity[3] = np.nan
    with pytest.raises(UnstableSimulation, match=r"not finite at t = "):
        engine.run_particles(rest, velocity, unheld(2), np.array([0.0, 0.1]))


def test_an_inverted_body_is_refused() -> None:
    lattice = block((2, 2, 2))
    rest = rest_nodes(lattice)
    engine = UpdatedLagrangian(Problem(lattice, NeoHookean(1e5, 0.3), rest, np.zeros(3)))
    with pytest.raises(UnstableSimulation, match="inverted"):
        engine.run_particles(rest * [1, 1, -1], np.zeros_like(rest), unheld(2), np.array([0.0, 0.1]))


class Draught:
    """A term on nodes that knows no particles."""


def test_what_the_form_cannot_hold_is_refused() -> None:
    rod = box_lattice(np.zeros(1), np.array([1.0]), (10,))
    with pytest.raises(SceneUnsupported, match="dimension 1"):
        UpdatedLagrangian(Problem(rod, RodLaw(100.0, 1e-3), rest_nodes(rod), GRAVITY))
    lattice = block()
    rest = rest_nodes(lattice)
    engine = UpdatedLagrangian(Problem(lattice, NeoHookean(1e5, 0.3), rest, GRAVITY))
    with pytest.raises(SceneUnsupported, match=r"Draught acts on the nodes .* has 128 particles"):
        UpdatedLagrangian(replace(engine.problem, terms=(Draught(),)))
    single = HeldNodes(np.array([0]), rest[None, :1].repeat(2, axis=0), np.zeros((2, 1, 3)))
    with pytest.raises(SceneUnsupported, match="1 nodes are held"):
        engine.run_particles(rest, np.zeros_like(rest), single, np.array([0.0, 0.1]))
