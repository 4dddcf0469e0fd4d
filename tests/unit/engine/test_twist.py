"""Twist of ropes between grips: energy and forces against an independent angle, balances, gradients, the ledger."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from bodies import GRAVITY, RodLaw, SheetLaw, rest_nodes
from scipy.spatial.transform import Rotation

from physworld.engine.gradients.adjoint import Adjoint
from physworld.engine.gradients.adjoint_reverse import Gradient
from physworld.engine.gradients.gradient import Direction, gradients
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.thin.twist import BoundTwist, Span, Twist, span_between
from physworld.engine.total.energy import run_with_ledger
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import TwistLost

LENGTH, CELLS = 0.36, 12
LAW = RodLaw(stretching_n=100.0, bending_n_m2=1e-3, torsion_ratio=0.7)


def rope() -> tuple[Lattice, np.ndarray, tuple[float, float]]:
    """A straight rope whose first and last cell are held: lattice, rest, arc lengths of the grips' faces."""
    lattice = box_lattice(np.zeros(1), np.array([LENGTH]), (CELLS,))
    return lattice, rest_nodes(lattice), (LENGTH / CELLS, LENGTH * (1 - 1 / CELLS))


def turned(times: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotations of a grip that stays and of one that turns by ``vector`` [rad] in the end, evenly, (2, T, 3, 3)."""
    share = (times - times[0]) / (times[-1] - times[0])
    last = Rotation.from_rotvec(share[:, None] * vector).as_matrix()
    return np.stack([np.repeat(np.eye(3)[None], len(times), axis=0), last])


class Bench:
    """One bound twist between frame 0 and 1, at half of the way."""

    def __init__(self, factor: np.ndarray | None = None) -> None:
        self.lattice, self.rest, ends = rope()
        times = np.array([0.0, 0.1])
        turns = turned(times, np.array([1.3, 0.2, 0.1]))
        span = span_between(self.lattice, self.rest, ends, turns, times)
        assert span is not None
        self.span = span
        problem = Problem(self.lattice, LAW, self.rest, GRAVITY, stiffness_factor=factor)
        self.bound: BoundTwist = Twist((span,)).bind(problem)
        self.clock = wp.array([0.1, 1e3, 1e-3], dtype=wp.float64)
        self.counter = wp.array([0, 50, 100], dtype=wp.int32)

    def forces(self, x: np.ndarray) -> np.ndarray:
        force = wp.zeros(x.size, dtype=wp.float64)
        nodes = wp.array(x.reshape(-1), dtype=wp.float64)
        self.bound.launch(nodes, nodes, self.clock, self.counter, force)
        return force.numpy().reshape(x.shape)

    def angle(self, x: np.ndarray, turn: Rotation | None = None) -> float:
        """The same angle by rotations of scipy, with both grips' frames turned by ``turn``."""
        step = 0.1
        frames = np.empty((2, 2, 3))
        for end in range(2):
            for part in range(2):
                start, goal = self.span.frames[:, end, part]
                one, two = self.span.rates[:, end, part]
                frames[end, part] = 0.5 * (start + goal) + step * (one - two) / 8  # Hermite's middle
        if turn is not None:
            frames = turn.apply(frames.reshape(-1, 3)).reshape(2, 2, 3)
        places = self.lattice.particle_coordinates[self.span.particles]
        slopes = self.lattice.interpolation(places, (1,)) @ x
        chain = [frames[0, 0], *slopes, frames[1, 0]]
        chain = [t / np.linalg.norm(t) for t in chain]
        director = np.cross(np.cross(chain[0], frames[0, 1]), chain[0])
        for t, u in pairwise(chain):
            axis = np.cross(t, u)
            sine = np.linalg.norm(axis)
            director = Rotation.from_rotvec(np.arctan2(sine, t @ u) * axis / max(sine, 1e-300)).apply(
                director
            )
        goal, last = frames[1, 1], chain[-1]
        return float(
            np.arctan2(last @ np.cross(director, goal), director @ goal - (last @ director) * (last @ goal))
        )

    def energy(self, x: np.ndarray, turn: Rotation | None = None) -> float:
        return 0.5 * self.angle(x, turn) ** 2 / float(self.bound.compliance.numpy()[0])


def bent(rest: np.ndarray) -> np.ndarray:
    return rest + 0.03 * np.random.default_rng(0).normal(size=rest.shape)


def test_the_angle_is_that_of_successive_least_rotations() -> None:
    bench = Bench()
    bench.forces(bent(bench.rest))
    assert bench.bound.angles_rad[0] == pytest.approx(bench.angle(bent(bench.rest)), abs=1e-12)


def test_forces_are_minus_the_slope_of_the_energy_and_add_up_to_nothing() -> None:
    bench = Bench()
    x, h = bent(bench.rest), 1e-6
    found = bench.forces(x)
    expected = np.empty_like(found)
    for place in np.ndindex(x.shape):
        step = np.zeros_like(x)
        step[place] = h
        expected[place] = -(bench.energy(x + step) - bench.energy(x - step)) / (2 * h)
    assert np.abs(found - expected).max() < 1e-7 * np.abs(found).max()
    assert np.abs(found.sum(axis=0)).max() < 1e-12 * np.abs(found).max()


def test_the_moment_of_the_forces_is_what_the_grips_take() -> None:
    bench = Bench()
    x, h = bent(bench.rest), 1e-6
    found = np.cross(x, bench.forces(x)).sum(axis=0)
    for axis in range(3):
        turns = [Rotation.from_rotvec(sign * h * np.eye(3)[axis]) for sign in (1, -1)]
        by_grips = -(bench.energy(x, turns[0]) - bench.energy(x, turns[1])) / (2 * h)
        assert found[axis] + by_grips == pytest.approx(0.0, abs=1e-7 * np.abs(found).max())
    whole = Rotation.from_rotvec([0.4, -0.7, 1.1])
    assert bench.angle(whole.apply(x), whole) == pytest.approx(bench.angle(x), abs=1e-12)


def test_a_soft_piece_takes_its_share_of_the_turn() -> None:
    factor = np.ones(2 * CELLS)
    factor[4:8] = 0.1
    soft, plain = Bench(factor), Bench()
    soft.forces(soft.rest), plain.forces(plain.rest)
    free = 2 * CELLS - 4
    ratio = free / (free - 4 + 4 / 0.1)
    assert soft.bound.moments_n_m[0] == pytest.approx(ratio * plain.bound.moments_n_m[0], rel=1e-12)
    assert plain.bound.moments_n_m[0] == pytest.approx(
        LAW.torsion_n_m2 * plain.bound.angles_rad[0] / (LENGTH * (1 - 2 / CELLS)), rel=1e-12
    )


def held_ends(times: np.ndarray, rest: np.ndarray, turns: np.ndarray) -> HeldNodes:
    """First and last cell of the rope, the last turned about its middle."""
    nodes = np.array([0, 1, 2, len(rest) - 3, len(rest) - 2, len(rest) - 1])
    positions = np.repeat(rest[nodes][None], len(times), axis=0)
    middle = rest[nodes[4]]
    positions[:, 3:] = middle + np.einsum("tij,nj->tni", turns[1], rest[nodes[3:]] - middle)
    return HeldNodes(nodes, positions, np.gradient(positions, times, axis=0))


def twisted(times: np.ndarray, vector: np.ndarray, **changes: object) -> tuple[Problem, HeldNodes]:
    lattice, rest, ends = rope()
    turns = turned(times, vector)
    span = span_between(lattice, rest, ends, turns, times)
    assert span is not None
    law = changes.pop("law", LAW)
    problem = Problem(lattice, law, rest, GRAVITY, terms=(Twist((span,)),), **changes)  # type: ignore[arg-type]
    return problem, held_ends(times, rest, turns)


def test_turns_add_up_beyond_one() -> None:
    times = np.linspace(0.0, 0.3, 31)
    problem, held = twisted(times, np.array([6 * np.pi, 0.0, 0.0]), law=replace(LAW, torsion_ratio=0.05))
    problem = replace(problem, gravity_m_s2=np.zeros(3))
    solver = TotalLagrangian(problem)
    nodes = solver.run(problem.rest, np.zeros_like(problem.rest), held, times)
    bound = solver.terms[0]
    assert isinstance(bound, BoundTwist)
    assert bound.angles_rad[0] == pytest.approx(6 * np.pi, rel=3e-3)  # at the last substep's start
    assert np.abs(nodes - problem.rest).max() < 1e-9  # below Greenhill's moment a straight rod stays straight


def test_the_ledger_closes_at_second_order_while_a_rope_is_twisted() -> None:
    times = np.linspace(0.0, 0.2, 21)
    problem, held = twisted(times, np.array([14.0, 0.5, 0.3]))
    velocity = np.zeros_like(problem.rest)
    lost = []
    step = TotalLagrangian(problem).time_step_s
    for share in (1.0, 0.5):
        _, ledger = run_with_ledger(problem, problem.rest, velocity, held, times, time_step_s=share * step)
        lost.append(float(np.abs(ledger.lost).max() / ledger.turnover))
        assert np.abs(ledger.term_work).max() < 1e-12  # twist is stored energy, no foreign work
    assert ledger.elastic[-1] > 0.5 * 0.5 * LAW.torsion_n_m2 * 14.0**2 / LENGTH
    assert lost[0] < 1e-6
    assert lost[1] < 0.45 * lost[0]


def test_a_step_just_below_the_limit_is_stable() -> None:
    times = np.linspace(0.0, 0.3, 31)
    problem, held = twisted(times, np.array([9.0, 0.0, 0.0]), law=replace(LAW, bending_n_m2=1e-5))
    stable = TotalLagrangian(problem).time_step_s / 0.6
    nodes = TotalLagrangian(problem, 0.95 * stable).run(problem.rest, 0 * problem.rest, held, times)
    assert np.isfinite(nodes).all()


def test_a_fold_is_refused_with_its_angle() -> None:
    bench = Bench()
    x = bench.rest.copy()
    x[7:, 0] = 2 * x[7, 0] - x[7:, 0]
    bench.forces(x)
    with pytest.raises(TwistLost, match=r"folded by 180 degrees"):
        bench.bound.check(0.1)


def test_a_grip_that_turns_too_far_in_a_frame_is_refused() -> None:
    times = np.array([0.0, 0.1])
    problem, held = twisted(times, np.array([2.8, 0.0, 0.0]))
    with pytest.raises(TwistLost, match=r"2\.80 rad between frames 0 and 1"):
        TotalLagrangian(problem).run(problem.rest, 0 * problem.rest, held, times)


def test_a_body_that_is_no_rod_has_no_twist() -> None:
    lattice = box_lattice(np.zeros(2), np.ones(2), (2, 2))
    problem = Problem(lattice, SheetLaw(1.0, 1.0), rest_nodes(lattice), GRAVITY)
    span = Span(np.array([0]), np.zeros((2, 2, 2, 3)), np.zeros((2, 2, 2, 3)))
    with pytest.raises(ValueError, match="torsional stiffness"):
        Twist((span,)).bind(problem)


TIMES = np.array([0.0, 0.010, 0.020, 0.032, 0.040])
TURN = np.array([7.0, 0.8, -0.5])


@cache
def differentiated() -> tuple[Problem, HeldNodes, np.ndarray, np.ndarray, Gradient, float]:
    factor = np.exp(0.1 * np.random.default_rng(5).normal(size=(2, 2 * CELLS)))
    problem, held = twisted(TIMES, TURN, stiffness_factor=factor[0], density_factor=factor[1])
    velocity = 0.2 * np.sin(30 * problem.rest)
    adjoint = Adjoint(problem, 0.8 * Adjoint(problem).time_step_s)
    run = adjoint.run(problem.rest, velocity, held, TIMES)
    weights = np.random.default_rng(1).normal(size=run.nodes.shape) * np.linspace(0, 1, 5)[:, None, None]
    return problem, held, velocity, weights, run.gradient(weights), adjoint.time_step_s


def loss(problem: Problem, velocity: np.ndarray | None = None, start: np.ndarray | None = None) -> float:
    own, held, known, weights, _, step = differentiated()
    speed, first = known if velocity is None else velocity, own.rest if start is None else start
    return float(np.sum(weights * TotalLagrangian(problem, step).run(first, speed, held, TIMES)))


def test_gradients_of_a_twisted_rope_against_differences_of_whole_runs() -> None:
    problem, _, velocity, _, g, _ = differentiated()
    rng = np.random.default_rng(2)
    along, push, kick = (
        rng.normal(size=2 * CELLS),
        rng.normal(size=problem.rest.shape),
        rng.normal(size=problem.rest.shape),
    )
    h = 1e-4

    def slope(make: object, step: float) -> float:
        return (make(step) - make(-step)) / (2 * step)  # type: ignore[operator]

    factor = problem.stiffness_factor
    assert factor is not None

    def stiffer(s: float) -> float:
        return loss(replace(problem, stiffness_factor=factor * np.exp(s * along)))

    pairs = [
        (g.log_stiffness @ along, slope(stiffer, h)),
        (np.sum(g.x * push), slope(lambda s: loss(problem, start=problem.rest + s * push), 1e-2 * h)),
        (np.sum(g.v * kick), slope(lambda s: loss(problem, velocity + s * kick), h)),
        (
            g.twist.sum(),
            slope(lambda s: loss(replace(problem, law=replace(LAW, torsion_ratio=LAW.torsion_ratio * np.exp(s)))), h),
        ),
    ]  # fmt: skip
    for found, expected in pairs:
        assert found == pytest.approx(expected, rel=1e-4)
    assert np.abs(g.twist).max() > 1e-3 * np.abs(g.log_stiffness).max()


def test_scalars_of_the_law_count_bending_and_twist_once() -> None:
    problem, held, velocity, weights, _, step = differentiated()
    run = Adjoint(problem, step).run(problem.rest, velocity, held, TIMES)

    class Setting:
        def __init__(self, law: RodLaw) -> None:
            self.problem, self.velocity, self.held = replace(problem, law=law), velocity, held

    h = 1e-4
    for name in ("torsion_ratio", "bending_n_m2"):
        value = getattr(LAW, name)
        sides = [Setting(replace(LAW, **{name: value * (1 + sign * h)})) for sign in (1, -1)]
        _, found = gradients(run, weights, {name: Direction(sides[0], sides[1], 2 * h * value)})
        expected = (loss(sides[0].problem) - loss(sides[1].problem)) / (2 * h * value)
        assert found[name] == pytest.approx(expected, rel=1e-3), name
