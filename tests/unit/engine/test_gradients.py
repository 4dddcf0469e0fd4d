"""Reverse-mode gradients against central differences of whole runs, on directions that do not cancel."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp
from bodies import GRAVITY, NeoHookean, RodLaw, SheetLaw, clamped_lattice, rest_nodes

from physworld.engine.gradients import adjoint_kernels, adjoint_stages_kernels
from physworld.engine.gradients.adjoint import Adjoint, RecordedRun
from physworld.engine.gradients.adjoint_reverse import Gradient
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import UnstableSimulation

pytestmark = pytest.mark.slow

SHAPES = ("solid", "solid with friction", "sheet", "sheet with friction", "rod", "rod with friction")
TIMES = np.array([0.0, 0.010, 0.020, 0.032, 0.040])  # uneven: friction sees a change of the time step
# solids strain in single precision, which limits the differences; sheets and rods are double throughout
TOLERANCE = {3: 5e-3, 2: 1e-4, 1: 1e-4}
STEP = {3: 3e-3, 2: 1e-4, 1: 1e-4}


@cache
def body(shape: str) -> tuple[Problem, np.ndarray, HeldNodes]:
    """A clamped body with random fields that is shaken: problem, velocity, grips."""
    friction = "friction" in shape
    if shape.startswith("solid"):
        lattice = clamped_lattice(0.12, (0.03, 0.03), (8, 2, 2))
        law = NeoHookean(5e4, 0.35, viscosity_pa_s=10.0 * friction)
    elif shape.startswith("sheet"):
        lattice = clamped_lattice(0.2, (0.2,), (8, 8))
        law = SheetLaw(300.0, 1e-4, relaxation_s=0.002 * friction)
    else:
        lattice, law = clamped_lattice(0.3, (), (16,)), RodLaw(100.0, 1e-4, relaxation_s=0.002 * friction)
    rest = rest_nodes(lattice)
    rng = np.random.default_rng(0)
    factors = np.exp(0.1 * rng.normal(size=(2, lattice.fill.size)))
    problem = Problem(
        lattice, law, rest, GRAVITY, drag_per_s=0.7, stiffness_factor=factors[0], density_factor=factors[1]
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
    weights = np.random.default_rng(1).normal(size=run.nodes.shape) * np.linspace(0, 1, 5)[:, None, None]
    return run, weights, run.gradient(weights), step


def loss(shape: str, **changes: object) -> float:
    """L of a run with other inputs, at the same time step."""
    problem, velocity, held = body(shape)
    _, weights, _, step = differentiated(shape)
    start = changes.pop("x", problem.rest)
    velocity, held = changes.pop("v", velocity), changes.pop("held", held)
    solver = TotalLagrangian(replace(problem, **changes), step)
    return float(np.sum(weights * solver.run(start, velocity, held, TIMES)))


def test_the_forward_pass_is_the_engines_own_run() -> None:
    problem, velocity, held = body("solid")
    run, _, _, step = differentiated("solid")
    assert np.array_equal(run.nodes, TotalLagrangian(problem, step).run(problem.rest, velocity, held, TIMES))


@pytest.mark.parametrize("shape", SHAPES)
def test_fields_of_stiffness_and_density(shape: str) -> None:
    problem, _, _ = body(shape)
    _, _, gradient, _ = differentiated(shape)
    h = STEP[problem.lattice.dim]
    for name, found in (
        ("stiffness_factor", gradient.log_stiffness),
        ("density_factor", gradient.log_density),
    ):
        along = np.random.default_rng(2).normal(size=len(found))
        field = getattr(problem, name)
        ends = [loss(shape, **{name: field * np.exp(sign * h * along)}) for sign in (1, -1)]
        assert found @ along == pytest.approx(
            (ends[0] - ends[1]) / (2 * h), rel=TOLERANCE[problem.lattice.dim]
        )


@pytest.mark.parametrize("shape", SHAPES)
def test_gravity_drag_initial_state_and_grips(shape: str) -> None:
    problem, velocity, held = body(shape)
    _, _, g, _ = differentiated(shape)
    rng = np.random.default_rng(3)
    pull, push, kick = (rng.normal(size=s) for s in (3, problem.rest.shape, problem.rest.shape))
    shift, swing = rng.normal(size=held.positions.shape), 30.0 * rng.normal(size=held.positions.shape)
    h = STEP[problem.lattice.dim]

    def slope(make: object, step: float) -> float:
        return (loss(shape, **make(step)) - loss(shape, **make(-step))) / (2 * step)  # type: ignore[operator]

    def moved(s: float) -> dict[str, HeldNodes]:
        positions, velocities = held.positions + s * shift, held.velocities + s * swing
        return {"held": HeldNodes(held.nodes, positions, velocities)}

    cases = {
        "gravity": (g.gravity @ pull, slope(lambda s: {"gravity_m_s2": GRAVITY + s * pull}, 100 * h)),
        "drag": (g.drag, slope(lambda s: {"drag_per_s": problem.drag_per_s + s}, 100 * h)),
        "x": (np.sum(g.x * push), slope(lambda s: {"x": problem.rest + s * push}, 0.01 * h)),
        "v": (np.sum(g.v * kick), slope(lambda s: {"v": velocity + s * kick}, h)),
        "grips": (
            np.sum(g.held_positions * shift) + np.sum(g.held_velocities * swing),
            slope(moved, 0.01 * h),
        ),
    }
    for name, (found, expected) in cases.items():
        assert found == pytest.approx(expected, rel=TOLERANCE[problem.lattice.dim]), name


@pytest.mark.parametrize("shape", ("solid with friction", "rod with friction"))
def test_running_every_frame_twice_gives_the_same_gradient(shape: str) -> None:
    problem, velocity, held = body(shape)
    kept, weights, gradient, step = differentiated(shape)
    again = Adjoint(problem, step, memory_mb=0.0).run(problem.rest, velocity, held, TIMES)
    assert again.twice and not kept.twice and again.nbytes < kept.nbytes
    other = again.gradient(weights)
    for name in ("log_stiffness", "log_density", "x", "v", "held_positions", "gravity"):
        assert np.allclose(getattr(other, name), getattr(gradient, name), rtol=1e-9, atol=1e-15), name


def test_velocities_kept_in_single_precision_are_enough() -> None:
    problem, velocity, held = body("rod with friction")
    kept, weights, gradient, step = differentiated("rod with friction")
    single = Adjoint(problem, step, memory_mb=0.6e-6 * kept.nbytes).run(problem.rest, velocity, held, TIMES)
    assert not single.twice and single.nbytes < kept.nbytes
    found = single.gradient(weights).log_stiffness
    assert np.abs(found - gradient.log_stiffness).max() < 1e-5 * np.abs(gradient.log_stiffness).max()


def test_what_does_not_matter_has_no_gradient() -> None:
    problem, _, held = body("rod")
    still = replace(
        held, positions=0 * held.positions + problem.rest[held.nodes], velocities=0 * held.velocities
    )
    calm = replace(problem, gravity_m_s2=np.zeros(3), stiffness_factor=None, density_factor=None)
    run = Adjoint(calm).run(problem.rest, 0 * problem.rest, still, TIMES)
    gradient = run.gradient(np.ones_like(run.nodes))
    scale = np.abs(gradient.gravity).max()
    assert scale > 0
    assert np.abs(gradient.log_stiffness).max() < 1e-9 * scale
    assert np.abs(gradient.log_density).max() < 1e-9 * scale
    assert abs(gradient.drag) < 1e-9 * scale


def test_an_unstable_run_says_so() -> None:
    problem, velocity, held = body("solid")
    thrown = 300.0 * np.random.default_rng(4).normal(size=velocity.shape)
    with pytest.raises(UnstableSimulation, match="inverted or blew up"):
        Adjoint(problem).run(problem.rest, thrown, held, TIMES)


def test_derivatives_of_another_shape_are_refused() -> None:
    run, weights, _, _ = differentiated("rod")
    with pytest.raises(ValueError, match="shape"):
        run.gradient(weights[1:])


def test_kernels_are_compiled_for_every_precision_at_once() -> None:
    """Whatever a run keeps, its kernels are declared: one more would compile their whole module anew."""
    differentiated("solid with friction"), differentiated("rod")
    modules = (adjoint_kernels, adjoint_stages_kernels)
    kernels = [found for module in modules for found in vars(module).values() if isinstance(found, wp.Kernel)]
    declared = {kernel.key: len(kernel.overloads) for kernel in kernels if kernel.is_generic}
    assert len(declared) == 7 and set(declared.values()) == {2}, declared
