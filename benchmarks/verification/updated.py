"""Verification of the updated Lagrangian form: what it shares with the total one, and what its transfers cost."""

from __future__ import annotations

import numpy as np

from benchmarks.verification.cases import (
    CLAMP_REACH,
    GRAVITY,
    Case,
    clamped_lattice,
    gripped,
    hold,
    nowhere,
    path,
    rest_nodes,
    ringing,
)
from benchmarks.verification.solids import SILICONE, SILICONE_SIZE
from physworld.engine.lattice.lattice import box_lattice
from physworld.engine.problem import Problem
from physworld.engine.terms.contact import GroundContact
from physworld.engine.updated.energy import run_particles_with_ledger
from physworld.engine.updated.formulation import UpdatedLagrangian
from physworld.engine.updated.transfer import Apic, Asflip, Transfer
from physworld.materials.neo_hookean import NeoHookean

_RING_S = 0.6


def free_fall(step: float) -> float:
    """Worst distance from the parabola after 0.5 s over the fall, with ``step`` times the default time step."""
    lattice = box_lattice(np.zeros(3), np.full(3, 0.06), (4, 4, 4))
    rest = rest_nodes(lattice)
    problem = Problem(lattice, NeoHookean(1e5, 0.3), rest, GRAVITY)
    velocity = np.tile([0.4, 0.0, 1.0], (len(rest), 1))
    times = np.linspace(0.0, 0.5, 6)
    engine = UpdatedLagrangian(problem, step * UpdatedLagrangian(problem).time_step_s)
    engine.crossing_limit *= step
    x = engine.run_particles(rest, velocity, hold(nowhere(), rest, len(times)), times)
    exact = x[0] + times[:, None, None] * velocity[0] + 0.5 * times[:, None, None] ** 2 * GRAVITY
    return float(np.abs(x - exact).max() / (0.5 * 9.81 * 0.5**2))


def axial_frequency(cells: float) -> float:
    """Relative error of the first axial frequency of a clamped bar, c / 4 L, nu = 0."""
    count, length, depth = int(cells), 0.3, 0.03
    law = NeoHookean(2e6, 0.0, density_kg_m3=600.0)
    across = max(2, count // 10)
    lattice = clamped_lattice(length, (depth, depth), (count, across, across), CLAMP_REACH)
    rest = rest_nodes(lattice)
    exact = 0.5 * np.pi * np.sqrt(2e6 / 600.0) / length
    velocity = np.zeros_like(rest)
    velocity[:, 0] = 0.05 * np.sin(0.5 * np.pi * np.clip(rest[:, 0], 0, length) / length)
    times = np.linspace(0.0, 3 * 2 * np.pi / exact, 100)
    engine = UpdatedLagrangian(Problem(lattice, law, rest, np.zeros(3)))
    nodes = engine.run(rest, velocity, hold(gripped(lattice), rest, len(times)), times)
    tip = path(lattice, nodes, (length, depth / 2, depth / 2))[:, 0] - length
    return ringing(times, tip, exact)[1] / exact - 1


def sliding_block(cells: float) -> float:
    """Relative error of the way that a sliding block takes to stop, v^2 / 2 mu g."""
    count = int(cells)
    law = NeoHookean(2e5, 0.3, viscosity_pa_s=20.0, density_kg_m3=500.0)
    lattice = box_lattice(np.zeros(3), np.array([0.12, 0.12, 0.03]), (2 * count, 2 * count, count // 2))
    friction, speed = 0.4, 0.8
    rest = rest_nodes(lattice)
    velocity = np.tile([speed, 0.0, 0.0], (len(rest), 1))
    ground = GroundContact(0.0, friction)
    times = np.linspace(0.0, 0.4, 9)
    engine = UpdatedLagrangian(Problem(lattice, law, rest, GRAVITY, terms=(ground,)))
    x = engine.run_particles(rest, velocity, hold(nowhere(), rest, len(times)), times)
    moved = engine.mass @ (x[-1] - x[0])[:, 0] / engine.mass.sum()
    return float(moved / (speed**2 / (2 * friction * 9.81)) - 1)


def momentum(transfer: Transfer, step: float) -> float:
    """Change of a free, ringing bar's momentum over its largest speed times its mass."""
    lattice = box_lattice(np.zeros(3), np.array([0.12, 0.06, 0.06]), (8, 4, 4))
    rest = rest_nodes(lattice)
    problem = Problem(lattice, NeoHookean(2e5, 0.3), rest, np.zeros(3))
    velocity = np.array([0.2, -0.1, 0.3]) + 0.2 * np.sin(60 * rest)
    times = np.array([0.0, 1e-4, 0.3, 0.3001])
    engine = UpdatedLagrangian(problem, step * UpdatedLagrangian(problem).time_step_s, transfer=transfer)
    x = engine.run_particles(rest, velocity, hold(nowhere(), rest, len(times)), times)
    early, late = (engine.mass @ (x[k + 1] - x[k]) / (times[k + 1] - times[k]) for k in (0, 2))
    return float(np.linalg.norm(late - early) / (engine.mass.sum() * np.linalg.norm(velocity, axis=1).max()))


def own_damping(transfer: Transfer, cells: float) -> float:
    """Damping ratio that the transfers give the silicone beam as it rings after being let go from level.

    Energy lost over twice the time integral of the kinetic energy, over 2 omega, as for the total Lagrangian form.
    """
    count = int(cells)
    across = round(0.3 * count)
    lattice = clamped_lattice(SILICONE_SIZE[0], SILICONE_SIZE[1:], (count, across, across), CLAMP_REACH)
    rest = rest_nodes(lattice)
    times = np.arange(0.0, _RING_S, 0.005)
    engine = UpdatedLagrangian(Problem(lattice, SILICONE, rest, GRAVITY), transfer=transfer)
    held = hold(gripped(lattice), rest, len(times))
    particles, ledger = run_particles_with_ledger(engine, rest, np.zeros_like(rest), held, times)
    free = np.argsort(particles[0, :, 0])[-4 * across**2 :]
    frequency = ringing(times, particles[:, free, 2].mean(axis=1), 2 * np.pi * 7.5)[1]
    drag = (ledger.lost[-1] + ledger.dissipated[-1]) / (2 * np.trapezoid(ledger.kinetic, times))
    return float(drag / (2 * frequency))


CASES = (
    Case("updated_free_fall", "updated form: free fall, 0.5 s, worst place", "x0 + v0 t + g t²/2", "dt",
         (1.0, 0.5, 0.25), free_fall, 1e-3, 0.8, size=float),
    Case("updated_axial_frequency", "updated form: clamped bar, axial frequency", "c / 4L", "dx", (10, 20, 40),
         axial_frequency, 5e-3, 0.6),
    Case("updated_sliding_block", "updated form: sliding block, way to a stop", "v² / 2μg", "dx", (4, 6, 8),
         sliding_block, 2e-3, 1.0),
    Case("updated_momentum_apic", "updated form, APIC: momentum of a free ringing bar", "conserved", "dt", (1.0, 0.5),
         lambda step: momentum(Apic(), step), 1e-4, size=float, no_order="single precision"),
    Case("updated_momentum_asflip", "updated form, ASFLIP: momentum of a free ringing bar", "conserved", "dt",
         (1.0, 0.5), lambda step: momentum(Asflip(), step), 1e-4, size=float, no_order="single precision"),
    Case("updated_damping_apic", "updated form, APIC: numerical damping ratio of the silicone beam, by energy", "0",
         "dx", (7, 10, 13), lambda n: own_damping(Apic(), n), 0.015, 1.0),
    Case("updated_damping_asflip", "updated form, ASFLIP: the same", "0", "dx", (7, 10, 13),
         lambda n: own_damping(Asflip(), n), 5e-3, 0.5),
)  # fmt: skip
