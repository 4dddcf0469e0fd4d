"""Gradients through the stages of strong friction, against central differences of whole runs on the same stages.

Directions are those of the gradient itself or one-signed, so nothing cancels. Solids strain in single precision, which
limits the differences.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bodies import GRAVITY, NeoHookean, RodLaw, SheetLaw, clamped_lattice, rest_nodes
from same_numbers import assert_same

from physworld.engine.gradients.adjoint import Adjoint, RecordedRun
from physworld.engine.gradients.adjoint_reverse import Gradient
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.formulation import TotalLagrangian

pytestmark = pytest.mark.slow

SHAPES = ("solid", "sheet", "rod", "drag alone")
TIMES = np.array([0.0, 0.010, 0.020, 0.032, 0.040])  # uneven: stages of several lengths
TOLERANCE = {3: 5e-3, 2: 1e-4, 1: 1e-4}
STEP = {3: 3e-3, 2: 1e-4, 1: 1e-4}


@cache
def body(shape: str) -> tuple[Problem, np.ndarray, HeldNodes]:
    """A clamped body with random fields that is shaken: problem, velocity, grips."""
    drag = 0.7
    if shape == "solid":
        lattice = clamped_lattice(0.12, (0.03, 0.03), (8, 2, 2))
        law = NeoHookean(5e4, 0.35, viscosity_pa_s=1000.0, density_kg_m3=600.0)
    elif shape == "sheet":
        lattice, law = clamped_lattice(0.2, (0.2,), (8, 8)), SheetLaw(300.0, 1e-2, relaxation_s=0.05)
    elif shape == "rod":
        lattice, law = (
            clamped_lattice(0.3, (), (16,)),
            RodLaw(50.0, 2e-2, relaxation_s=0.05, density_kg_m=0.05),
        )
    else:
        lattice, drag = clamped_lattice(0.12, (0.03, 0.03), (8, 2, 2)), 3000.0
        law = NeoHookean(5e4, 0.35, density_kg_m3=600.0)
    rest = rest_nodes(lattice)
    rng = np.random.default_rng(0)
    factors = np.exp(0.1 * rng.normal(size=(2, lattice.fill.size)))
    problem = Problem(
        lattice, law, rest, GRAVITY, drag_per_s=drag, stiffness_factor=factors[0], density_factor=factors[1]
    )
    nodes = np.unique(lattice.cell_nodes[lattice.cells[:, 0] < 1])
    shake = (0.01 * np.sin(40 * TIMES))[:, None, None] * np.array([0.0, 0.5, 1.0])
    positions = rest[nodes] + shake
    held = HeldNodes(nodes, positions, np.gradient(positions, TIMES, axis=0))
    return problem, 0.2 * np.sin(30 * rest), held


@cache
def differentiated(shape: str) -> tuple[RecordedRun, np.ndarray, Gradient, float]:
    """A run, the weights of L = sum(w x), its gradient, and the time step."""
    problem, velocity, held = body(shape)
    step = 0.9 * Adjoint(problem).time_step_s
    run = Adjoint(problem, step).run(problem.rest, velocity, held, TIMES)
    assert np.all(run.stages >= 3)
    weights = 1.0 + np.random.default_rng(1).normal(size=run.nodes.shape)
    weights *= np.linspace(0, 1, 5)[:, None, None]
    return run, weights, run.gradient(weights), step


def loss(shape: str, **changes: object) -> float:
    """L of a run with other inputs, at the same time step."""
    problem, velocity, held = body(shape)
    _, weights, _, step = differentiated(shape)
    start = changes.pop("x", problem.rest)
    velocity, held = changes.pop("v", velocity), changes.pop("held", held)
    solver = TotalLagrangian(replace(problem, **changes), step)
    assert solver.relaxed
    return float(np.sum(weights * solver.run(start, velocity, held, TIMES)))


@pytest.mark.parametrize("shape", SHAPES)
def test_the_recorded_run_is_the_engines_own_and_far_beyond_the_explicit_step(shape: str) -> None:
    problem, velocity, held = body(shape)
    run, _, _, step = differentiated(shape)
    solver = TotalLagrangian(problem, step)
    assert_same(run.nodes, solver.run(problem.rest, velocity, held, TIMES))
    assert step > (1.0 if shape == "drag alone" else 8.0) * solver.steps.explicit_s()


@pytest.mark.parametrize("shape", SHAPES)
def test_fields_through_stages(shape: str) -> None:
    problem, _, _ = body(shape)
    _, _, gradient, _ = differentiated(shape)
    h = STEP[problem.lattice.dim]
    for name, found in (
        ("stiffness_factor", gradient.log_stiffness),
        ("density_factor", gradient.log_density),
    ):
        field = getattr(problem, name)
        for along in (found / np.abs(found).max(), np.random.default_rng(2).normal(size=len(found))):
            ends = [loss(shape, **{name: field * np.exp(sign * h * along)}) for sign in (1, -1)]
            scale = 0.1 * np.linalg.norm(found) * np.linalg.norm(along)
            expected = (ends[0] - ends[1]) / (2 * h)
            assert abs(found @ along - expected) < TOLERANCE[problem.lattice.dim] * max(
                abs(expected), scale
            ), name


@pytest.mark.parametrize("shape", SHAPES)
def test_numbers_of_the_law_through_stages(shape: str) -> None:
    problem, _, _ = body(shape)
    _, _, gradient, _ = differentiated(shape)
    names = {
        2: {"membrane": "membrane_n_m", "bending": "bending_n_m", "relaxation": "relaxation_s"},
        1: {"stretching": "stretching_n", "bending": "bending_n_m2", "relaxation": "relaxation_s"},
        3: {"viscosity": "viscosity_pa_s"},
    }[problem.lattice.dim]
    for column, values in zip(gradient.columns, gradient.law.T, strict=True):
        if column not in names or getattr(problem.law, names[column]) == 0:
            continue
        value = getattr(problem.law, names[column])
        h = STEP[problem.lattice.dim]
        ends = [
            loss(shape, law=replace(problem.law, **{names[column]: value * np.exp(sign * h)}))
            for sign in (1, -1)
        ]
        expected = (ends[0] - ends[1]) / (2 * h)
        assert values.sum() == pytest.approx(expected, rel=TOLERANCE[problem.lattice.dim]), column


@pytest.mark.parametrize("shape", SHAPES)
def test_gravity_drag_initial_state_and_grips_through_stages(shape: str) -> None:
    problem, velocity, held = body(shape)
    _, _, g, _ = differentiated(shape)
    h = STEP[problem.lattice.dim]
    pull, push, kick = (a / np.abs(a).max() for a in (g.gravity, g.x, g.v))
    shift, swing = (a / np.abs(a).max() for a in (g.held_positions, g.held_velocities))
    swing = 30.0 * swing

    def slope(make: object, step: float) -> float:
        return (loss(shape, **make(step)) - loss(shape, **make(-step))) / (2 * step)  # type: ignore[operator]

    def moved(s: float) -> dict[str, HeldNodes]:
        return {"held": HeldNodes(held.nodes, held.positions + s * shift, held.velocities + s * swing)}

    cases = {
        "gravity": (g.gravity @ pull, slope(lambda s: {"gravity_m_s2": GRAVITY + s * pull}, 100 * h)),
        "drag": (g.drag, slope(lambda s: {"drag_per_s": problem.drag_per_s + s}, 100 * h)),
        "x": (np.sum(g.x * push), slope(lambda s: {"x": problem.rest + s * push}, 0.01 * h)),
        "v": (np.sum(g.v * kick), slope(lambda s: {"v": velocity + s * kick}, h)),
        "grips": (
            np.sum(g.held_positions * shift) + np.sum(g.held_velocities * swing), slope(moved, 0.01 * h),
        ),
    }  # fmt: skip
    for name, (found, expected) in cases.items():
        assert found == pytest.approx(expected, rel=TOLERANCE[problem.lattice.dim]), name


@pytest.mark.parametrize("shape", ("solid", "rod"))
def test_running_every_frame_twice_takes_the_same_stages(shape: str) -> None:
    problem, velocity, held = body(shape)
    kept, weights, gradient, step = differentiated(shape)
    again = Adjoint(problem, step, memory_mb=0.0).run(problem.rest, velocity, held, TIMES)
    assert again.twice and not kept.twice and again.nbytes < kept.nbytes
    other = again.gradient(weights)
    for name in ("log_stiffness", "log_density", "x", "v", "held_positions", "gravity", "law"):
        found = getattr(gradient, name)
        assert np.allclose(getattr(other, name), found, rtol=1e-9, atol=1e-9 * np.abs(found).max()), name


def test_velocities_and_forces_kept_in_single_precision_are_enough_for_stages() -> None:
    problem, velocity, held = body("rod")
    kept, weights, gradient, step = differentiated("rod")
    single = Adjoint(problem, step, memory_mb=0.6e-6 * kept.nbytes).run(problem.rest, velocity, held, TIMES)
    assert not single.twice and single.nbytes < kept.nbytes
    found = single.gradient(weights).log_stiffness
    assert np.abs(found - gradient.log_stiffness).max() < 1e-5 * np.abs(gradient.log_stiffness).max()
