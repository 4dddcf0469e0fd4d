"""A field of the ground's friction: the same forces where it is even, and its gradient against whole runs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bodies import GRAVITY, NeoHookean, RodLaw, SheetLaw, rest_nodes

from physworld.engine.gradients.adjoint import Adjoint
from physworld.engine.gradients.adjoint_reverse import Gradient
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.contact import GroundContact
from physworld.engine.total.formulation import TotalLagrangian

pytestmark = pytest.mark.slow

TIMES = np.linspace(0.0, 0.06, 7)
SAME = {3: 1e-6, 2: 1e-12, 1: 1e-12}  # [m] solids add up single-precision forces
AGREES = 0.03
LAWS = {3: NeoHookean(2e4, 0.3), 2: SheetLaw(100.0, 1e-3, density_kg_m2=0.5), 1: RodLaw(100.0, 1e-3)}


def body(dim: int) -> Lattice:
    size = np.array([0.16, 0.08, 0.04])[:dim]
    return box_lattice(np.zeros(dim), size, ((8, 4, 2), (8, 4), (12,))[3 - dim])


def sliding(dim: int, factor: np.ndarray | None) -> tuple[Problem, np.ndarray, HeldNodes]:
    """A body that slides and turns on the ground at its lower side, free of grips."""
    lattice, law = body(dim), LAWS[dim]
    rest = rest_nodes(lattice)
    contact = GroundContact(0.0 if dim == 3 else -1e-3, 0.4, 0.0 if dim == 3 else 1e-3)
    problem = Problem(lattice, law, rest, GRAVITY, terms=(contact,), friction_factor=factor)
    velocity = np.zeros_like(rest)
    velocity[:, 0], velocity[:, 1] = 0.3, 0.5 + 3.0 * rest[:, 0]
    nobody = np.empty((len(TIMES), 0, 3))
    return problem, velocity, HeldNodes(np.empty(0, dtype=int), nobody, nobody)


@pytest.mark.parametrize("dim", (3, 2, 1))
def test_an_even_field_is_the_ground_as_it_was(dim: int) -> None:
    plain, velocity, held = sliding(dim, None)
    even = replace(plain, friction_factor=np.full(plain.lattice.fill.size, 1.5))
    rougher = replace(plain, terms=(replace(plain.terms[0], friction=0.6),))
    solvers = [TotalLagrangian(problem) for problem in (even, rougher)]
    runs = [solver.run(plain.rest, velocity, held, TIMES) for solver in solvers]
    assert np.abs(runs[0] - runs[1]).max() < SAME[dim]
    impulses = [solver.terms[0].impulse_n_s for solver in solvers]  # type: ignore[attr-defined]
    assert impulses[0] == pytest.approx(impulses[1], rel=1e-4)
    assert np.abs(runs[0] - TotalLagrangian(plain).run(plain.rest, velocity, held, TIMES)).max() > 1e-4


def rough_to_smooth(dim: int) -> np.ndarray:
    along = body(dim).particle_coordinates[:, 0] / 0.16
    return np.exp(0.6 * (1 - 2 * along))


@cache
def differentiated(dim: int) -> tuple[np.ndarray, Gradient, float]:
    problem, velocity, held = sliding(dim, rough_to_smooth(dim))
    step = 0.8 * TotalLagrangian(problem).time_step_s
    run = Adjoint(problem, step).run(problem.rest, velocity, held, TIMES)
    weights = (
        np.random.default_rng(1).normal(size=run.nodes.shape) * np.linspace(0, 1, len(TIMES))[:, None, None]
    )
    weights += 5.0 * np.array([1.0, 1.0, 0.0])
    return weights, run.gradient(weights), step


@pytest.mark.parametrize("dim", (3, 2, 1))
def test_a_gradient_by_the_friction_field_is_that_of_whole_runs(dim: int) -> None:
    weights, gradient, step = differentiated(dim)
    along = body(dim).particle_coordinates[:, 0] / 0.16
    h = 1e-2 if dim == 3 else 1e-3
    assert gradient.log_friction is not None
    for direction in (np.ones_like(along), along < 0.5, np.sin(7 * along)):
        ends = []
        for sign in (1, -1):
            problem, velocity, held = sliding(dim, rough_to_smooth(dim) * np.exp(sign * h * direction))
            ends.append(
                np.sum(weights * TotalLagrangian(problem, step).run(problem.rest, velocity, held, TIMES))
            )
        expected = (ends[0] - ends[1]) / (2 * h)
        assert gradient.log_friction @ direction == pytest.approx(expected, rel=AGREES)


def test_a_run_without_a_field_has_no_gradient_by_it() -> None:
    problem, velocity, held = sliding(1, None)
    run = Adjoint(problem).run(problem.rest, velocity, held, TIMES)
    assert run.gradient(np.ones_like(run.nodes)).log_friction is None


def test_factors_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="each of 24 particles"):
        TotalLagrangian(sliding(1, np.ones(3))[0])
    with pytest.raises(ValueError, match="not negative"):
        TotalLagrangian(sliding(1, np.full(24, -1.0))[0])
