"""The ledger's columns against each other and against closed forms; momentum; errors before a blow-up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.verification.cases import GRAVITY, clamped_lattice, gripped, hold, nowhere, rest_nodes
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.contact import GroundContact
from physworld.engine.total.energy import EnergyLedger, run_with_ledger
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import CFLViolation, ParticlesLeftTheGrid, UnstableSimulation
from physworld.materials.laws import Law
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw

LEAPFROG = 5e-5  # share of the energy exchanged that a leapfrog's bounded oscillation may reach
ROUND_OFF = 1e-12

BODIES: dict[str, tuple[Lattice, Law, Law]] = {
    "solid": (
        clamped_lattice(0.2, (0.03, 0.03), (8, 2, 2)),
        NeoHookean(2e5, 0.35, density_kg_m3=600.0),
        NeoHookean(2e5, 0.35, viscosity_pa_s=20.0, density_kg_m3=600.0),
    ),
    "sheet": (
        clamped_lattice(0.2, (0.1,), (10, 5)),
        SheetLaw(300.0, 1e-2, density_kg_m2=0.5),
        SheetLaw(300.0, 1e-2, relaxation_s=2e-3, density_kg_m2=0.5),
    ),
    "rod": (
        clamped_lattice(0.3, (), (20,)),
        RodLaw(200.0, 2e-3, density_kg_m=0.05),
        RodLaw(200.0, 2e-3, relaxation_s=2e-3, density_kg_m=0.05),
    ),
}
TIMES = np.linspace(0.0, 0.4, 41)


def swing(lattice: Lattice, law: Law, shake_m: float = 0.0, **problem: object) -> EnergyLedger:
    """A body let go from level, its clamp shaken up and down."""
    rest = rest_nodes(lattice)
    held = hold(gripped(lattice), rest, len(TIMES))
    up, omega = np.array([0.0, 0.0, 1.0]), 25.0
    held = replace(
        held,
        positions=held.positions + shake_m * np.sin(omega * TIMES)[:, None, None] * up,
        velocities=held.velocities + shake_m * omega * np.cos(omega * TIMES)[:, None, None] * up,
    )
    return run_with_ledger(
        Problem(lattice, law, rest, GRAVITY, **problem), rest, np.zeros_like(rest), held, TIMES
    )[1]


@pytest.mark.parametrize("name", BODIES)
def test_a_free_swing_loses_no_energy(name: str) -> None:
    lattice, law, _ = BODIES[name]
    ledger = swing(lattice, law)
    assert ledger.kinetic.max() > 0.05 * ledger.turnover
    assert np.abs(ledger.lost).max() < LEAPFROG * ledger.turnover
    for silent in (ledger.grip_work, ledger.term_work, ledger.drag):
        assert np.abs(silent).max() < ROUND_OFF
    assert np.abs(ledger.internal_friction).max() < 1e-6 * ledger.turnover


@pytest.mark.parametrize("name", BODIES)
def test_what_drag_friction_and_grips_do_is_accounted_for(name: str) -> None:
    lattice, _, friction = BODIES[name]
    ledger = swing(lattice, friction, shake_m=0.01, drag_per_s=1.0)
    assert np.abs(ledger.lost).max() < 20 * LEAPFROG * ledger.turnover
    assert np.all(np.diff(ledger.drag) >= 0) and ledger.drag[-1] > 0.01 * ledger.turnover
    assert np.all(np.diff(ledger.internal_friction) >= -1e-9 * ledger.turnover)
    assert ledger.internal_friction[-1] > 1e-3 * ledger.turnover
    assert np.abs(ledger.grip_work).max() > 0.01 * ledger.turnover


def test_the_loss_goes_with_the_square_of_the_time_step() -> None:
    lattice, law, _ = BODIES["rod"]
    rest = rest_nodes(lattice)
    problem = Problem(lattice, law, rest, GRAVITY)
    held, step = hold(gripped(lattice), rest, len(TIMES)), TotalLagrangian(problem).time_step_s
    worst = []
    for share in (1.0, 0.5):
        ledger = run_with_ledger(problem, rest, 0 * rest, held, TIMES, time_step_s=share * step)[1]
        worst.append(np.abs(ledger.lost).max())
    assert 1.5 < np.log2(worst[0] / worst[1]) < 2.5


def test_a_falling_body_trades_height_for_speed() -> None:
    lattice = box_lattice(np.zeros(3), np.full(3, 0.05), (2, 2, 2))
    law, rest = NeoHookean(1e5, 0.3), rest_nodes(lattice)
    problem = Problem(lattice, law, rest, GRAVITY)
    nobody = HeldNodes(nowhere(), *np.zeros((2, len(TIMES), 0, 3)))
    nodes, ledger = run_with_ledger(problem, rest, np.zeros_like(rest), nobody, TIMES)
    mass = 1000.0 * 0.05**3
    np.testing.assert_allclose(ledger.kinetic, 0.5 * mass * (9.81 * TIMES) ** 2, atol=1e-12)
    np.testing.assert_allclose(ledger.gravitational, -ledger.kinetic, atol=1e-12)
    plain = TotalLagrangian(problem).run(rest, np.zeros_like(rest), nobody, TIMES)
    np.testing.assert_array_equal(nodes, plain)


def test_friction_on_the_ground_takes_the_energy_of_a_slide() -> None:
    lattice = box_lattice(np.zeros(3), np.array([0.12, 0.12, 0.03]), (4, 4, 1))
    law, rest = NeoHookean(2e5, 0.3, density_kg_m3=500.0), rest_nodes(lattice)
    problem = Problem(lattice, law, rest, GRAVITY, terms=(GroundContact(0.0, 0.4),))
    velocity = np.tile([0.6, 0.0, 0.0], (len(rest), 1))
    nobody = HeldNodes(nowhere(), *np.zeros((2, len(TIMES), 0, 3)))
    ledger = run_with_ledger(problem, rest, velocity, nobody, TIMES)[1]
    start = 0.5 * 500.0 * 0.12 * 0.12 * 0.03 * 0.6**2
    assert ledger.term_work[-1] == pytest.approx(-start, rel=0.05)
    assert np.abs(ledger.lost).max() < 1e-3 * start


@pytest.mark.parametrize("name", BODIES)
def test_momentum_of_a_free_body_is_conserved_to_round_off(name: str) -> None:
    """Solids add float32 stresses: every cell's forces cancel to about 1e-7 of their size, in sum far less."""
    lattice, _, friction = BODIES[name]
    rest = rest_nodes(lattice)
    solver = TotalLagrangian(Problem(lattice, friction, rest, np.zeros(3)))
    mass = solver.mass
    velocity = np.random.default_rng(4).normal(scale=0.1, size=rest.shape)
    nobody = HeldNodes(nowhere(), *np.zeros((2, len(TIMES), 0, 3)))
    nodes = solver.run(rest, velocity, nobody, TIMES)
    centre = np.einsum("n,tni->ti", mass, nodes) / mass.sum()
    steady = centre[0] + np.outer(TIMES, mass @ velocity / mass.sum())
    way = 0.1 * TIMES[-1]
    assert np.abs(centre - steady).max() < (1e-6 if name == "solid" else 1e-11) * way


def test_a_time_step_beyond_the_stable_one_is_refused_with_both_numbers() -> None:
    lattice, law, _ = BODIES["rod"]
    with pytest.raises(CFLViolation, match=r"time step 0\.1 s exceeds the stable .* s"):
        TotalLagrangian(Problem(lattice, law, rest_nodes(lattice), GRAVITY), time_step_s=0.1)


def test_a_state_that_is_not_finite_ends_the_run_with_its_time_and_step() -> None:
    lattice, law, _ = BODIES["solid"]
    rest = rest_nodes(lattice)
    velocity = np.zeros_like(rest)
    velocity[-1] = np.nan
    with pytest.raises(UnstableSimulation, match=r"at t = 0\.0100 s with time step .* nodes not finite"):
        TotalLagrangian(Problem(lattice, law, rest, GRAVITY)).run(
            rest, velocity, hold(gripped(lattice), rest, 2), np.array([0.0, 0.01])
        )


def test_material_that_leaves_every_workspace_ends_the_run_with_its_distance() -> None:
    lattice = box_lattice(np.zeros(3), np.full(3, 0.05), (2, 2, 2))
    rest = rest_nodes(lattice)
    nobody = HeldNodes(nowhere(), *np.zeros((2, 2, 0, 3)))
    with pytest.raises(ParticlesLeftTheGrid, match=r"a node is .* m from its start at t = 1\.0000 s"):
        TotalLagrangian(Problem(lattice, NeoHookean(1e3, 0.3), rest, np.zeros(3))).run(
            rest, np.full_like(rest, 500.0), nobody, np.array([0.0, 1.0])
        )
