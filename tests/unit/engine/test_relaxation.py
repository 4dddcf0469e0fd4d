"""Friction in sub-steps of its own: its polynomial, its operator, its decay, its energy, and where it is taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from bodies import (
    GRAVITY,
    NeoHookean,
    RodLaw,
    SheetLaw,
    clamped_lattice,
    material_point,
    rest_nodes,
    still_clamp,
)
from same_numbers import assert_same

from physworld.devices import default_device
from physworld.engine.gradients.adjoint import Adjoint
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.energy import run_with_ledger
from physworld.engine.total.forces import InternalForces
from physworld.engine.total.formulation import Run, TotalLagrangian
from physworld.engine.total.friction import FrictionForces
from physworld.engine.total.relaxation import coefficients, stages_for
from physworld.engine.total.stability import DRAG_SHRINK, EXPLICIT_SHRINK
from physworld.errors import CFLViolation
from physworld.materials.laws import Law

pytestmark = pytest.mark.slow

SINGLE = 2e-4  # of forces that are differences of single-precision ones over a small displacement
BODIES: dict[str, tuple[Lattice, Law]] = {
    "solid": (
        clamped_lattice(0.2, (0.03, 0.03), (8, 2, 2)),
        NeoHookean(2e5, 0.35, viscosity_pa_s=3000.0, density_kg_m3=600.0),
    ),
    "sheet": (
        clamped_lattice(0.2, (0.1,), (10, 5)),
        SheetLaw(300.0, 1e-2, relaxation_s=0.05, density_kg_m2=0.5),
    ),
    "rod": (clamped_lattice(0.3, (), (20,)), RodLaw(50.0, 2e-2, relaxation_s=0.05, density_kg_m=0.05)),
}
TIMES = np.linspace(0.0, 0.3, 31)


def polynomial(stages: int, stiffness: np.ndarray) -> np.ndarray:
    """What the stages make of a velocity that decays at ``stiffness`` over dt."""
    table, _ = coefficients(stages)
    y0 = np.ones_like(stiffness)
    last, other = y0, y0 - table[0, 2] * stiffness * y0
    before, last = last, other
    for a, b, own, first in table[1:]:
        before, last = last, a * last + b * before + (1 - a - b) * y0 - stiffness * (own * last + first * y0)
    return last


@pytest.mark.parametrize("stages", [3, 5, 9, 21, 65])
def test_the_polynomial_decays_to_second_order_and_keeps_the_leapfrogs_limit(stages: int) -> None:
    widest = 0.5 * (stages**2 + stages - 2)
    z = np.linspace(1e-9, widest, 20000)
    p = polynomial(stages, z)
    assert p.min() > 0.0 and p.max() <= 1.0
    assert np.all(p >= (2 - z) / (2 + z) - 1e-12)
    small = np.array([1e-2])
    assert abs(polynomial(stages, small) - np.exp(-small)) < 0.2 * small**3
    assert stages_for(widest) == stages and stages_for(widest + 1e-6) == stages + 2
    assert coefficients(stages)[1].sum() == pytest.approx(1.0, abs=1e-12)


def deformed(lattice: Lattice, amount: float) -> np.ndarray:
    """Nodes of a bent, stretched, turned body, (n, 3)."""
    x = rest_nodes(lattice)
    waves = np.stack(
        [np.sin(9 * x[:, 0]), np.cos(7 * x[:, 0] + 11 * x[:, 1]), np.sin(8 * x[:, 0]) * x[:, 0] * 5], 1
    )
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    return (x + amount * waves) @ turn.T


def on_device(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values).reshape(-1), dtype=wp.float64, device=default_device())


def rubbed(friction: FrictionForces, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    force, at = wp.zeros(x.size, dtype=wp.float64, device=default_device()), on_device(x)
    friction.prepare(at)
    friction.launch(on_device(v), force)
    return force.numpy().reshape(-1, 3)


@pytest.mark.parametrize("name", BODIES)
def test_the_operator_is_the_friction_of_the_explicit_forces(name: str) -> None:
    lattice, law = BODIES[name]
    ones, rest = np.ones(lattice.fill.size), rest_nodes(lattice)
    x = deformed(lattice, 3e-3)
    v = np.random.default_rng(1).normal(size=x.shape)
    dt = 1e-5
    found = []
    for friction in (law, replace(law, **{"viscosity_pa_s" if name == "solid" else "relaxation_s": 0.0})):
        forces = InternalForces(lattice, friction, ones, rest, default_device())
        out = wp.zeros(x.size, dtype=wp.float64, device=default_device())
        clock = wp.array([0.0, 1.0 / dt, dt], dtype=wp.float64, device=default_device())
        forces.launch(on_device(x - dt * v), clock, out)
        out.zero_()
        forces.launch(on_device(x), clock, out)
        found.append(out.numpy().reshape(-1, 3))
    expected = found[0] - found[1]
    force = rubbed(FrictionForces(lattice, law, ones, rest, default_device()), x, v)
    assert np.abs(force - expected).max() < 20 * SINGLE * np.abs(expected).max()


@pytest.mark.parametrize("name", BODIES)
def test_the_operator_is_symmetric_takes_energy_and_is_silent_in_rigid_motion(name: str) -> None:
    lattice, law = BODIES[name]
    friction = FrictionForces(lattice, law, np.ones(lattice.fill.size), rest_nodes(lattice), default_device())
    x = deformed(lattice, 3e-3)
    u, v = np.random.default_rng(2).normal(size=(2, *x.shape))
    size = np.abs(np.sum(u * rubbed(friction, x, u)))
    assert np.sum(u * rubbed(friction, x, v)) == pytest.approx(
        np.sum(v * rubbed(friction, x, u)), abs=1e-6 * size
    )
    assert np.sum(u * rubbed(friction, x, u)) < 0.0
    rigid = np.array([0.3, -0.2, 0.1]) + np.cross([1.0, -2.0, 0.5], x)
    assert np.abs(rubbed(friction, x, rigid)).max() < 1e-5 * np.abs(rubbed(friction, x, u)).max()


def oscillator(times: np.ndarray, frequency: float, ratio: float) -> np.ndarray:
    """A damped oscillator let go from 0 at the speed 1."""
    root = np.sqrt(complex(ratio**2 - 1)) * frequency
    return np.real(np.exp(-ratio * frequency * times) * np.sinh(root * times) / root)


@pytest.mark.parametrize("shrink", [10.0, 100.0])
@pytest.mark.parametrize("kind", ["bar", "rod"])
def test_strong_friction_decays_as_the_closed_form_at_the_frictionless_step(kind: str, shrink: float) -> None:
    if kind == "bar":
        length, axis, tau = 0.3, 0, 4.9e-3 * shrink / 10.0
        law: Law = NeoHookean(2e5, 0.0, viscosity_pa_s=0.5 * tau * 2e5, density_kg_m3=600.0)
        lattice = clamped_lattice(length, (0.03, 0.03), (20, 2, 2))
        rest = rest_nodes(lattice)
        shape = np.sin(0.5 * np.pi * np.clip(rest[:, 0], 0, length) / length)
        frequency = 0.5 * np.pi * np.sqrt(2e5 / 600.0) / (length - lattice.spacing[0] / (2 * np.sqrt(3)))
        point: tuple[float, ...] = (length, 0.015, 0.015)
    else:
        length, axis, tau = 0.3, 2, 8.45e-4 * shrink / 10.0
        law = RodLaw(2.0, 2e-2, relaxation_s=tau, density_kg_m=0.05)
        lattice = clamped_lattice(length, (), (20,))
        rest = rest_nodes(lattice)
        root, s = 1.8751040687, np.clip(rest[:, 0], 0, length) / length
        weight = (np.cosh(root) + np.cos(root)) / (np.sinh(root) + np.sin(root))
        shape = np.cosh(root * s) - np.cos(root * s) - weight * (np.sinh(root * s) - np.sin(root * s))
        shape[rest[:, 0] < 0] = 0.0
        shape /= 2.0
        frequency = root**2 * np.sqrt(2e-2 / 0.05) / length**2
        point = (length,)
    ratio = 0.5 * tau * frequency
    times = np.linspace(0.0, 2 * 2 * np.pi / frequency * max(1.0, 2 * ratio), 40)
    velocity = np.zeros_like(rest)
    speed = {"bar": 0.02, "rod": 1e-4}[kind]  # small strains, above what single precision resolves
    velocity[:, axis] = speed * shape
    problem = Problem(lattice, law, rest, np.zeros(3))
    solver = TotalLagrangian(problem)
    steps = solver.steps
    assert steps.relaxed_s() / steps.explicit_s() == pytest.approx(shrink, rel=0.2)
    assert solver.relaxed and solver.time_step_s == steps.relaxed_s()
    nodes = solver.run(rest, velocity, still_clamp(lattice, rest, len(times)), times)
    moved = material_point(lattice, nodes, point)[:, axis]
    exact = speed * oscillator(times, frequency, ratio)
    assert np.abs(moved - moved[0] - exact).max() < 0.015 * np.abs(exact).max()


@pytest.mark.parametrize("name", BODIES)
def test_energy_never_grows_and_the_ledger_closes(name: str) -> None:
    lattice, law = BODIES[name]
    rest = rest_nodes(lattice)
    problem = Problem(lattice, law, rest, GRAVITY, drag_per_s=1.0)
    assert TotalLagrangian(problem).relaxed
    held = still_clamp(lattice, rest, len(TIMES))
    nodes, ledger = run_with_ledger(problem, rest, np.zeros_like(rest), held, TIMES)
    assert np.diff(ledger.mechanical).max() < 1e-4 * ledger.turnover
    assert ledger.internal_friction[-1] > 0.3 * ledger.turnover and np.all(
        np.diff(ledger.internal_friction) >= 0
    )
    assert ledger.drag[-1] > 0 and np.all(np.diff(ledger.drag) >= 0)
    assert np.abs(ledger.grip_work).max() < 1e-9
    assert np.abs(ledger.lost).max() < 2e-3 * ledger.turnover
    plain = TotalLagrangian(problem).run(rest, np.zeros_like(rest), held, TIMES)
    assert_same(plain, nodes)


def test_a_body_that_nothing_holds_keeps_its_momentum() -> None:
    lattice, law = BODIES["solid"]
    rest = rest_nodes(lattice)
    velocity = np.random.default_rng(5).normal(scale=0.05, size=rest.shape)
    solver = TotalLagrangian(Problem(lattice, law, rest, np.zeros(3)))
    assert solver.relaxed
    nodes = solver.run(rest, velocity, still_clamp(lattice, rest, len(TIMES), clamped=False), TIMES)
    momentum = solver.mass @ velocity
    moved = (solver.mass @ (nodes[-1] - nodes[0])) / TIMES[-1]
    assert moved == pytest.approx(momentum, abs=SINGLE * np.linalg.norm(momentum))


def test_the_stages_follow_a_body_that_is_pressed_flat() -> None:
    law = NeoHookean(2e5, 0.0, viscosity_pa_s=3000.0, density_kg_m3=600.0)
    lattice = box_lattice(np.zeros(3), np.array([0.06, 0.03, 0.03]), (6, 3, 3))
    rest = rest_nodes(lattice)
    ends = [np.unique(lattice.cell_nodes[lattice.cells[:, 0] == k]) for k in (0, 5)]
    times = np.linspace(0.0, 0.2, 41)
    way = 0.018 * np.sin(0.5 * np.pi * times / times[-1]) ** 2
    speed = np.gradient(way, times)
    positions = np.repeat(rest[np.concatenate(ends)][None], len(times), axis=0)
    velocities = np.zeros_like(positions)
    positions[:, len(ends[0]) :, 0] -= way[:, None]
    velocities[:, len(ends[0]) :, 0] -= speed[:, None]
    held = HeldNodes(np.concatenate(ends), positions, velocities)
    solver = TotalLagrangian(Problem(lattice, law, rest, np.zeros(3)))
    run = Run(solver, rest, np.zeros_like(rest), held, times)
    stages = []
    for frame in range(len(times) - 1):
        nodes = run.advance(frame)
        stages.append(run.stages)
    assert np.isfinite(nodes).all() and stages[-1] > stages[0]


def test_weak_friction_stays_explicit_and_gradients_follow_the_engine() -> None:
    lattice, law = BODIES["solid"]
    rest = rest_nodes(lattice)
    weak = TotalLagrangian(Problem(lattice, replace(law, viscosity_pa_s=30.0), rest, GRAVITY))
    assert not weak.relaxed and weak.time_step_s == weak.steps.explicit_s() < weak.steps.relaxed_s()
    assert weak.steps.relaxed_s() < EXPLICIT_SHRINK * weak.steps.explicit_s()
    strong = Problem(lattice, law, rest, GRAVITY)
    solver = TotalLagrangian(strong)
    assert not TotalLagrangian(strong, 0.5 * solver.steps.explicit_s()).relaxed
    assert TotalLagrangian(strong, 0.5 * solver.time_step_s).relaxed
    assert Adjoint(strong).time_step_s == solver.time_step_s
    for always in (TotalLagrangian, Adjoint):
        with pytest.raises(CFLViolation, match="exceeds the stable"):
            always(strong, 2.1 * solver.time_step_s)
    with pytest.raises(CFLViolation, match="exceeds the stable"):
        TotalLagrangian(strong, solver.time_step_s, "explicit")


@pytest.mark.parametrize("rate", [3e2, 1e4])
def test_drag_of_any_strength_leaves_the_step(rate: float) -> None:
    lattice = box_lattice(np.zeros(3), np.full(3, 0.05), (2, 2, 2))
    law, rest = NeoHookean(5e4, 0.3, density_kg_m3=500.0), rest_nodes(lattice)
    solver = TotalLagrangian(Problem(lattice, law, rest, GRAVITY, drag_per_s=rate))
    still = TotalLagrangian(Problem(lattice, law, rest, GRAVITY))
    assert solver.relaxed and solver.time_step_s == still.time_step_s
    assert solver.steps.explicit_s() < solver.time_step_s / DRAG_SHRINK
    times = np.linspace(0.0, 0.1, 11)
    velocity = np.tile([1.0, 0.0, 0.0], (len(rest), 1))
    nodes = solver.run(rest, velocity, still_clamp(lattice, rest, len(times), clamped=False), times)
    fallen = (nodes - nodes[0]).mean(axis=1)
    exact = 9.81 * (times / rate - (1 - np.exp(-rate * times)) / rate**2)
    terminal = 9.81 / rate
    assert np.abs(fallen[:, 2] + exact).max() < 2 * terminal * solver.time_step_s
    assert (fallen[-2, 2] - fallen[-1, 2]) / (times[1] - times[0]) == pytest.approx(terminal, rel=1e-6)
    assert fallen[-1, 0] == pytest.approx(1.0 / rate, abs=1.5 * solver.time_step_s)
