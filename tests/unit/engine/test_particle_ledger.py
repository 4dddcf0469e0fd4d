"""The ledger of the updated Lagrangian form: its columns against each other and closed forms; what transfers lose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.verification.cases import GRAVITY, clamped_lattice, gripped, hold, nowhere, rest_nodes
from physworld.effects.air_drag_quadratic import QuadraticDrag
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.contact import GroundContact
from physworld.engine.updated.energy import ParticleLedger, run_particles_with_ledger
from physworld.engine.updated.formulation import UpdatedLagrangian
from physworld.engine.updated.transfer import Apic, Asflip, Transfer
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.plastic import VonMises
from physworld.materials.solid import SolidLaw

pytestmark = pytest.mark.slow

SINGLE = 2e-4  # velocities are single precision and summed substep by substep
BEAM = clamped_lattice(0.1, (0.03, 0.03), (10, 3, 3))
LAW = NeoHookean(264e3, 0.35, density_kg_m3=1070.0)
TIMES = np.linspace(0.0, 0.4, 41)


def swing(
    law: SolidLaw = LAW, transfer: Transfer | None = None, shake_m: float = 0.0, **problem: object
) -> ParticleLedger:
    """A beam let go from level, its clamp shaken up and down."""
    rest, omega, up = rest_nodes(BEAM), 25.0, np.array([0.0, 0.0, 1.0])
    held = hold(gripped(BEAM), rest, len(TIMES))
    held = replace(
        held,
        positions=held.positions + shake_m * np.sin(omega * TIMES)[:, None, None] * up,
        velocities=held.velocities + shake_m * omega * np.cos(omega * TIMES)[:, None, None] * up,
    )
    engine = UpdatedLagrangian(Problem(BEAM, law, rest, GRAVITY, **problem), transfer=transfer)
    velocity = np.zeros_like(rest)
    velocity[held.nodes] = held.velocities[0]
    return run_particles_with_ledger(engine, rest, velocity, held, TIMES)[1]


def test_a_free_swing_loses_to_the_transfers_alone() -> None:
    ledger = swing()
    assert ledger.kinetic.max() > 0.1 * ledger.turnover
    for silent in (ledger.grip_work, ledger.contact_work, ledger.term_work, ledger.drag):
        assert np.abs(silent).max() < SINGLE * ledger.turnover
    assert np.diff(ledger.transfers).min() > -0.05 * ledger.transfers[-1]
    assert ledger.transfers[-1] > 0.05 * ledger.turnover
    assert abs(ledger.dissipated[-1]) < 0.2 * ledger.transfers[-1]
    assert np.abs(ledger.dissipated).max() < 0.03 * ledger.turnover
    assert np.abs(ledger.lost - ledger.transfers).max() < 0.04 * ledger.transfers[-1]


def test_apic_loses_more_than_asflip() -> None:
    apic, asflip = swing(transfer=Apic()), swing(transfer=Asflip())
    assert apic.lost[-1] > 3 * abs(asflip.lost[-1])


def test_the_metered_run_is_the_run_without_a_meter() -> None:
    rest = rest_nodes(BEAM)
    held = hold(gripped(BEAM), rest, len(TIMES))
    problem = Problem(BEAM, LAW, rest, GRAVITY)
    metered, _ = run_particles_with_ledger(UpdatedLagrangian(problem), rest, np.zeros_like(rest), held, TIMES)
    plain = UpdatedLagrangian(problem).run_particles(rest, np.zeros_like(rest), held, TIMES)
    assert np.abs(metered - plain).max() < 1e-4 * np.abs(plain - plain[0]).max()


def test_what_grips_drag_terms_and_friction_do_is_accounted_for() -> None:
    ledger = swing(
        replace(LAW, viscosity_pa_s=30.0), shake_m=0.005, drag_per_s=1.0, terms=(QuadraticDrag(0.5),)
    )
    assert np.ptp(ledger.grip_work) > 0.03 * ledger.turnover
    assert ledger.drag[-1] > 0.01 * ledger.turnover and np.all(np.diff(ledger.drag) >= 0)
    assert ledger.term_work[-1] < 0.0 and np.all(np.diff(ledger.term_work) <= 0)
    assert ledger.dissipated[-1] > 0.02 * ledger.turnover
    assert np.abs(ledger.lost - ledger.transfers).max() < 0.005 * ledger.turnover


def test_a_grip_that_lifts_does_the_work_of_the_weight() -> None:
    """Slow enough that the body is stiff: the grip's work is the change of potential and kinetic energy."""
    law = replace(LAW, youngs_modulus_pa=2e6)
    rest, height = rest_nodes(BEAM), 0.05
    nodes = np.arange(len(rest))
    share = TIMES / TIMES[-1]
    way = height * (3 * share**2 - 2 * share**3)
    speed = height * (6 * share - 6 * share**2) / TIMES[-1]
    up = np.array([0.0, 0.0, 1.0])
    held = HeldNodes(
        nodes,
        rest[None] + way[:, None, None] * up,
        np.repeat((speed[:, None] * up)[:, None], len(rest), axis=1),
    )
    engine = UpdatedLagrangian(Problem(BEAM, law, rest, GRAVITY))
    ledger = run_particles_with_ledger(engine, rest, np.zeros_like(rest), held, TIMES)[1]
    assert ledger.gravitational[-1] == pytest.approx(engine.mass.sum() * 9.81 * height, rel=1e-6)
    assert ledger.grip_work == pytest.approx(
        ledger.mechanical - ledger.mechanical[0], abs=5e-3 * ledger.turnover
    )


def block(law: SolidLaw, **of: object) -> tuple[Lattice, np.ndarray, Problem]:
    lattice = box_lattice(np.zeros(3), np.full(3, 0.06), (6, 6, 6))
    rest = rest_nodes(lattice)
    return lattice, rest, Problem(lattice, law, rest, **of)  # type: ignore[arg-type]


def test_a_free_fall_loses_nothing_and_keeps_its_momentum() -> None:
    _, rest, problem = block(LAW, gravity_m_s2=GRAVITY)
    velocity = np.tile([0.3, 0.0, 0.5], (len(rest), 1))
    engine = UpdatedLagrangian(problem)
    x, ledger = run_particles_with_ledger(engine, rest, velocity, hold(nowhere(), rest, len(TIMES)), TIMES)
    step = TIMES[1] / np.ceil(TIMES[1] / engine.time_step_s)
    assert np.abs(ledger.lost).max() < 1.5 * step / TIMES[-1] * ledger.turnover
    assert np.abs(ledger.transfers).max() < SINGLE * ledger.turnover
    momentum = engine.mass @ (x[-1] - x[0]) / TIMES[-1]
    expected = engine.mass.sum() * np.array([0.3, 0.0, 0.5 - 0.5 * 9.81 * TIMES[-1]])
    assert momentum == pytest.approx(expected, abs=2e-3 * np.linalg.norm(expected))


def test_a_block_that_slides_to_a_stop_gives_its_energy_to_the_ground() -> None:
    friction, speed = 0.4, 0.6
    _, rest, problem = block(replace(LAW, youngs_modulus_pa=2e5), gravity_m_s2=GRAVITY, terms=())
    problem = replace(problem, terms=(GroundContact(0.0, friction),))
    velocity = np.tile([speed, 0.0, 0.0], (len(rest), 1))
    engine = UpdatedLagrangian(problem)
    _, ledger = run_particles_with_ledger(engine, rest, velocity, hold(nowhere(), rest, len(TIMES)), TIMES)
    kinetic = 0.5 * engine.mass.sum() * speed**2
    assert ledger.kinetic[-1] < 1e-3 * kinetic
    assert ledger.contact_work[-1] == pytest.approx(-kinetic, rel=0.05)
    assert np.abs(ledger.lost - ledger.transfers).max() < 0.02 * kinetic


def test_plastic_flow_dissipates_the_yield_stress_times_the_strain() -> None:
    """A block pressed by a tenth between two grips: dissipated is sigma_y times strain times volume."""
    law = NeoHookean(1e6, 0.3, density_kg_m3=1000.0)
    lattice, rest, problem = block(law, gravity_m_s2=np.zeros(3))
    ends = [np.unique(lattice.cell_nodes[lattice.cells[:, 2] == k]) for k in (0, 5)]
    times = np.linspace(0.0, 0.5, 26)
    share = times / times[-1]
    way = 0.006 * (3 * share**2 - 2 * share**3)
    speed = 0.006 * (6 * share - 6 * share**2) / times[-1]
    nodes = np.concatenate(ends)
    positions = np.repeat(rest[nodes][None], len(times), axis=0)
    velocities = np.zeros_like(positions)
    positions[:, len(ends[0]) :, 2] -= way[:, None]
    velocities[:, len(ends[0]) :, 2] -= speed[:, None]
    yields = 1e4
    engine = UpdatedLagrangian(problem, plasticity=VonMises(yields))
    _, ledger = run_particles_with_ledger(
        engine, rest, np.zeros_like(rest), HeldNodes(nodes, positions, velocities), times
    )
    assert np.all(np.diff(ledger.dissipated) > -1e-3 * ledger.dissipated[-1])
    assert ledger.dissipated[-1] > 0.6 * ledger.grip_work[-1]
    volume, between = 0.06**2 * 0.04, 0.006 / 0.04
    assert ledger.dissipated[-1] == pytest.approx(yields * between * volume, rel=0.35)
    assert np.abs(ledger.lost - ledger.transfers).max() < 0.02 * ledger.turnover
