"""The engine against closed forms of beam, plate, rope and contact mechanics."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import (
    GRAVITY,
    NeoHookean,
    RodLaw,
    SheetLaw,
    clamped_lattice,
    material_point,
    rest_nodes,
    run,
    still_clamp,
)
from scipy.optimize import brentq, curve_fit

from physworld.engine.lattice.lattice import box_lattice
from physworld.engine.problem import HeldNodes, Problem, nodal_mass
from physworld.engine.terms.contact import GroundContact
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import CFLViolation, UnstableSimulation

pytestmark = pytest.mark.slow

LENGTH, DEPTH = 0.3, 0.03
FIRST_ROOT = 1.8751  # of cos x cosh x = -1, the clamped-free beam


def ringing(times: np.ndarray, tip: np.ndarray, guess: float) -> tuple[float, float]:
    """Mean and angular frequency [rad/s] of a tip that falls from level and rings about its droop."""
    droop = tip.mean()
    (mean, _, frequency, _), _ = curve_fit(
        lambda t, m, a, w, d: m + a * np.cos(w * t) * np.exp(-d * t), times, tip, [droop, -droop, guess, 0.0]
    )
    return float(mean), float(frequency)


def cantilever_error(cells: int) -> tuple[float, float]:
    """Relative errors of droop and frequency of a solid cantilever, nu = 0, against Euler and Bernoulli."""
    law = NeoHookean(2e6, 0.0, density_kg_m3=600.0)
    lattice = clamped_lattice(LENGTH, (DEPTH, DEPTH), (cells, max(1, cells // 10), max(1, cells // 10)))
    times = np.arange(0.0, 0.6, 0.005)
    nodes = run(lattice, law, times)
    tip = material_point(lattice, nodes, (LENGTH, DEPTH / 2, DEPTH / 2))[:, 2] - DEPTH / 2
    stiffness = law.youngs_modulus_pa * DEPTH**4 / 12
    line_mass = law.density_kg_m3 * DEPTH**2
    frequency = FIRST_ROOT**2 * np.sqrt(stiffness / line_mass / LENGTH**4)
    droop = -line_mass * 9.81 * LENGTH**4 / (8 * stiffness)
    mean, found = ringing(times, tip, frequency)
    return mean / droop - 1, found / frequency - 1


def test_a_solid_cantilever_converges_to_beam_theory() -> None:
    coarse, fine = cantilever_error(10), cantilever_error(30)
    assert abs(fine[1]) < abs(coarse[1])
    assert abs(fine[0]) < abs(coarse[0])
    assert abs(fine[1]) < 0.025  # the clamp holds about a quarter of a cell too much: first order in dx
    assert abs(fine[0]) < 0.06


def test_a_rod_cantilever_rings_at_the_frequency_of_beam_theory() -> None:
    law = RodLaw(stretching_n=200.0, bending_n_m2=2e-2, density_kg_m=0.05)
    lattice = clamped_lattice(LENGTH, (), (40,))
    times = np.arange(0.0, 0.8, 0.005)
    nodes = run(lattice, law, times, gravity=GRAVITY * 0.1)
    frequency = FIRST_ROOT**2 * np.sqrt(law.bending_n_m2 / law.density_kg_m / LENGTH**4)
    droop = -law.density_kg_m * 0.981 * LENGTH**4 / (8 * law.bending_n_m2)
    mean, found = ringing(times, material_point(lattice, nodes, (LENGTH,))[:, 2], frequency)
    assert found == pytest.approx(frequency, rel=0.02)
    assert mean == pytest.approx(droop, rel=0.04)


def test_a_sheet_strip_rings_at_the_frequency_of_plate_theory() -> None:
    law = SheetLaw(membrane_n_m=300.0, bending_n_m=1.5e-2, poissons_ratio=0.0, density_kg_m2=0.5)
    lattice = clamped_lattice(LENGTH, (0.1,), (30, 6))
    times = np.arange(0.0, 1.0, 0.005)
    nodes = run(lattice, law, times, gravity=GRAVITY * 0.05)
    frequency = FIRST_ROOT**2 * np.sqrt(law.bending_n_m / law.density_kg_m2 / LENGTH**4)
    droop = -law.density_kg_m2 * 0.4905 * LENGTH**4 / (8 * law.bending_n_m)
    mean, found = ringing(times, material_point(lattice, nodes, (LENGTH, 0.05))[:, 2], frequency)
    assert found == pytest.approx(frequency, rel=0.02)
    assert mean == pytest.approx(droop, rel=0.05)


def test_a_slack_rope_settles_on_the_catenary() -> None:
    span, length = 0.7, 1.0
    law = RodLaw(stretching_n=400.0, bending_n_m2=1e-5, relaxation_s=2e-4, density_kg_m=0.05)
    lattice = box_lattice(np.zeros(1), np.array([length]), (60,))
    start = rest_nodes(lattice)
    half = brentq(lambda a: np.sin(a) / a - span / length, 0.1, 3.0)  # first shape: a circular arc
    radius, angle = length / (2 * half), (lattice.node_coordinates[:, 0] / length - 0.5) * 2 * half
    start[:, 0], start[:, 2] = radius * np.sin(angle), radius * (np.cos(half) - np.cos(angle))
    times = np.linspace(0.0, 6.0, 121)
    held_nodes = np.array([0, 1, len(start) - 2, len(start) - 1])
    # both ends: the node pair is moved so that the end point (half a cell in) stays put and may turn freely
    held_nodes = held_nodes[[1, 2]]
    positions = np.repeat(start[held_nodes][None], len(times), axis=0)
    problem = Problem(lattice, law, rest_nodes(lattice), GRAVITY, drag_per_s=3.0)
    nodes = TotalLagrangian(problem).run(
        start, np.zeros_like(start), HeldNodes(held_nodes, positions, np.zeros_like(positions)), times
    )
    first, last = nodes[-1, held_nodes[0]], nodes[-1, held_nodes[1]]
    middle = material_point(lattice, nodes[-1:], (length / 2,))[0]
    reach = last[0] - first[0]
    between = lattice.node_coordinates[held_nodes[1], 0] - lattice.node_coordinates[held_nodes[0], 0]
    scale = brentq(lambda a: 2 * a * np.sinh(reach / (2 * a)) - between, 0.02, 10.0)
    sag = scale * (np.cosh(reach / (2 * scale)) - 1)
    assert first[2] - middle[2] == pytest.approx(sag, rel=0.02)


def test_free_vibration_is_hardly_damped_by_the_scheme() -> None:
    """Total Lagrangian without transfer: amplitude loss below a drag of 0.1 1/s (APIC: 0.3 to 0.45)."""
    law = NeoHookean(9e5, 0.3, density_kg_m3=600.0)
    lattice = clamped_lattice(LENGTH, (0.042, 0.042), (21, 3, 3))
    times = np.arange(0.0, 3.0, 0.01)
    tip = material_point(lattice, run(lattice, law, times), (LENGTH, 0.021, 0.021))[:, 2]
    early, late = np.ptp(tip[:100]), np.ptp(tip[-100:])
    rate = -2 * np.log(late / early) / 2.0
    assert abs(rate) < 0.1


def test_drag_slows_free_flight_as_its_closed_form_says() -> None:
    law = NeoHookean(1e5, 0.3)
    lattice = box_lattice(np.zeros(3), np.full(3, 0.05), (2, 2, 2))
    velocity = np.tile([1.0, 0.0, 0.5], (len(lattice.nodes), 1))
    times = np.linspace(0.0, 0.5, 11)
    nodes = run(lattice, law, times, gravity=np.zeros(3), velocity=velocity, clamped=False, drag_per_s=2.0)
    moved = material_point(lattice, nodes, (0.025, 0.025, 0.025)) - 0.025
    expected = np.outer((1 - np.exp(-2.0 * times)) / 2.0, [1.0, 0.0, 0.5])
    assert np.abs(moved - expected).max() < 2e-3 * np.abs(expected).max()


def test_momentum_of_a_free_body_is_conserved() -> None:
    law = NeoHookean(5e4, 0.3, viscosity_pa_s=5.0)
    lattice = box_lattice(np.zeros(3), np.array([0.1, 0.05, 0.05]), (4, 2, 2))
    mass = nodal_mass(lattice, law, None)
    rng = np.random.default_rng(4)
    velocity = rng.normal(scale=0.2, size=(len(mass), 3))
    times = np.linspace(0.0, 0.2, 9)
    nodes = run(lattice, law, times, gravity=np.zeros(3), velocity=velocity, clamped=False)
    centre = np.einsum("n,tni->ti", mass, nodes) / mass.sum()
    drift = centre - centre[0] - np.outer(times, mass @ velocity / mass.sum())
    assert np.abs(drift).max() < 1e-6


def test_a_block_on_the_ground_carries_its_weight_and_slides_to_the_coulomb_distance() -> None:
    law = NeoHookean(2e5, 0.3, viscosity_pa_s=20.0, density_kg_m3=500.0)
    lattice = box_lattice(np.zeros(3), np.array([0.12, 0.12, 0.06]), (4, 4, 2))
    friction, speed = 0.4, 0.8
    ground = GroundContact(0.0, friction)
    velocity = np.tile([speed, 0.0, 0.0], (len(lattice.nodes), 1))
    times = np.linspace(0.0, 0.6, 61)
    nodes = run(lattice, law, times, velocity=velocity, clamped=False, terms=(ground,))
    path = material_point(lattice, nodes, (0.06, 0.06, 0.03))
    assert path[-1, 0] - path[0, 0] == pytest.approx(speed**2 / (2 * friction * 9.81), rel=0.08)
    assert abs(path[-1, 2] - 0.03) < 0.002


def test_a_time_step_above_the_stable_limit_is_refused_and_just_below_it_runs() -> None:
    law = NeoHookean(1e5, 0.3)
    lattice = clamped_lattice(0.2, (0.04, 0.04), (10, 2, 2))
    problem = Problem(lattice, law, rest_nodes(lattice), GRAVITY)
    limit = TotalLagrangian(problem).time_step_s / 0.6
    with pytest.raises(CFLViolation, match="exceeds the stable"):
        TotalLagrangian(problem, time_step_s=1.05 * limit)
    times = np.linspace(0.0, 0.3, 7)
    solver = TotalLagrangian(problem, time_step_s=0.9 * limit)
    nodes = solver.run(
        rest_nodes(lattice),
        np.zeros((len(solver.mass), 3)),
        still_clamp(lattice, rest_nodes(lattice), 7),
        times,
    )
    assert np.isfinite(nodes).all()


def test_the_limit_is_sharp_enough_to_matter() -> None:
    """Well above the limit the run blows up: the limit is no more than a factor of two too careful."""
    law = NeoHookean(1e5, 0.3)
    lattice = clamped_lattice(0.2, (0.04, 0.04), (10, 2, 2))
    solver = TotalLagrangian(Problem(lattice, law, rest_nodes(lattice), GRAVITY))
    solver.time_step_s *= 2.0 / 0.6
    times = np.linspace(0.0, 1.0, 7)
    with pytest.raises(UnstableSimulation, match="blew up"):
        solver.run(
            rest_nodes(lattice),
            np.zeros((len(solver.mass), 3)),
            still_clamp(lattice, rest_nodes(lattice), 7),
            times,
        )
