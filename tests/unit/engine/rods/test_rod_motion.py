"""Motion of discrete rods: frequencies and their order, losses of every kind against closed forms, paths of a run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import warp as wp
from discrete import FALL, LAW, WEIGHTLESS, along, line, problem, run, still, tree, uniform
from scipy.optimize import brentq, curve_fit

from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.rods import discrete_rods
from physworld.engine.rods.chain import chain
from physworld.engine.rods.discrete_rods import DiscreteRods
from physworld.materials.cable import CableLaw

LENGTH = 0.6
CLAMPED_FREE = 1.8751040687119611
CHAIN_ROOT = 2.404825557695773  # first zero of J0


def ringing(times: np.ndarray, signal: np.ndarray, guess: float) -> tuple[float, float]:
    """Angular frequency and decay rate [1/s] of a decaying oscillation about zero."""

    def wave(t: np.ndarray, a: float, b: float, omega: float, rate: float) -> np.ndarray:
        found: np.ndarray = np.exp(-rate * t) * (a * np.cos(omega * t) + b * np.sin(omega * t))
        return found

    size = np.abs(signal).max()
    found, _ = curve_fit(wave, times, signal / size, p0=[0.1, 1.0, guess, 0.0])
    return float(found[2]), float(found[3])


def cantilever(edges: int, dt: float, relaxation_s: float = 0.0) -> tuple[float, float]:
    """First frequency of a clamped rod over Euler's, less 1, and its decay rate over tau omega^2 / 2."""
    law = replace(LAW, relaxation_s=relaxation_s)
    size = LENGTH / (edges - 0.5)  # the clamp is the middle of the first edge
    lattice = line(edges, edges * size)
    start = along(lattice)
    exact = CLAMPED_FREE**2 * np.sqrt(law.bending_n_m2 / law.density) / LENGTH**2
    s = np.clip((start[:, 0] - 0.5 * size) / LENGTH, 0.0, None)
    z = CLAMPED_FREE * s
    ratio = (np.sin(CLAMPED_FREE) + np.sinh(CLAMPED_FREE)) / (np.cos(CLAMPED_FREE) + np.cosh(CLAMPED_FREE))
    shape = np.sin(z) - np.sinh(z) - ratio * (np.cos(z) - np.cosh(z))
    velocity = np.zeros_like(start)
    velocity[:, 2] = 1e-3 * shape / shape[-1]
    times = np.linspace(0.0, 3.0 * 2.0 * np.pi / exact, 151)
    path, _ = run(
        problem(lattice, law, frames=151, edges=(1,)), start, times, dt, velocity, still([0, 1], start, 151)
    )
    omega, rate = ringing(times, path[:, -1, 2], exact)
    return omega / exact - 1.0, rate / max(0.5 * relaxation_s * exact**2, 1e-12)


def test_a_clamped_rod_rings_as_euler_s_beam_at_second_order_in_its_edges() -> None:
    coarse, fine = cantilever(10, 2e-3)[0], cantilever(20, 2e-3)[0]
    assert abs(fine) < 1.5e-3
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.35)


def test_its_frequency_is_of_second_order_in_the_step() -> None:
    exact = cantilever(8, 5e-3)[0]
    coarse, fine = cantilever(8, 8e-2)[0] - exact, cantilever(8, 4e-2)[0] - exact
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.2)


def test_a_mode_decays_at_kelvin_and_voigt_s_rate() -> None:
    assert cantilever(15, 2e-3, relaxation_s=0.03)[1] == pytest.approx(1.0, abs=0.02)


def test_a_hanging_rope_that_does_not_bend_swings_as_bernoulli_s_chain() -> None:
    lattice = line(40)
    start = along(lattice, (0.0, 0.0, -1.0))
    law = replace(LAW, bending_n_m2=1e-9, stretching_n=5000.0)
    exact = 0.5 * CHAIN_ROOT * np.sqrt(9.81)
    velocity = np.zeros_like(start)
    velocity[:, 0] = 5e-3 * lattice.distances**1.3
    times = np.linspace(0.0, 8.0 * 2.0 * np.pi / exact, 400)
    path, _ = run(
        problem(lattice, law, gravity=FALL), start, times, velocity=velocity, held=still([0], start, 400)
    )
    assert ringing(times, path[:, -1, 0], exact)[0] == pytest.approx(exact, rel=3e-3)


def hinge(
    law: CableLaw, turned: float, seconds: float, drag: float = 0.0, natural: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and angles [rad] of one joint: a held edge and a free one, let go at ``turned``."""
    lattice, dt = chain(np.array([-1, 0, 1]), np.array([0.0, 0.1, 0.1])), 1e-3
    start = np.array([[-0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1 * np.cos(turned), 0.1 * np.sin(turned), 0.0]])
    times = np.arange(round(seconds / dt) + 1) * dt
    # a positive turn about z is a negative curvature about the second of the directors that chains take here
    one = problem(lattice, law, natural=uniform(lattice, 0.0, -natural / 0.1), edges=(1,), frames=len(times),
                  drag_per_s=drag)  # fmt: skip
    path, _ = run(one, start, times, dt, held=still([0, 1], start, len(times)))
    return times, np.arctan2(path[:, 2, 1], path[:, 2, 0])


def crests(angles: np.ndarray) -> np.ndarray:
    """Sizes of an oscillation at its turning points."""
    inner = (angles[1:-1] - angles[:-2]) * (angles[2:] - angles[1:-1]) <= 0.0
    found: np.ndarray = np.abs(angles[1:-1][inner])
    return found


DAHL = replace(LAW, friction_per_m=0.05, friction_onset_per_m=0.02)


def test_a_cycle_loses_what_dahl_s_friction_dissipates() -> None:
    _, angles = hinge(DAHL, 0.1, 1.5)
    found = np.concatenate([[0.1], crests(angles)])
    # over the stiffness B / l, the friction moment B k_f is the angle f, the onset of slip o
    f, o = 0.05 * 0.1, 0.02 * 0.1
    expected = [0.1]
    for half in range(6):
        # between turning points a stroke from z = -1 to 1 takes f (stroke - 2 o), the first, from z = 0, f (stroke - o)
        lost = o if half == 0 else 2.0 * o
        before = expected[-1]
        expected.append(
            brentq(lambda a, b=before, c=lost: 0.5 * (b**2 - a**2) - f * (a + b - c), 0.0, before)  # type: ignore[misc]
        )
    # the joint's angle is 2 tan of half its turn, 0.1 % more; turning points are seen to a step
    assert found[:7] == pytest.approx(expected, abs=3e-4)


def test_friction_does_not_ask_how_fast() -> None:
    _, fast = hinge(DAHL, 0.1, 1.5)
    _, slow = hinge(replace(DAHL, density_kg_m=4.0 * DAHL.density_kg_m), 0.1, 3.0)
    assert crests(slow)[:6] == pytest.approx(crests(fast)[:6], abs=2e-4)


def test_a_maxwell_branch_creeps_at_its_rate() -> None:
    """Of k - k0 + c (k - q) = 0 and T_c q' = k - q: from k0 / (1 + c) to k0 within (1 + c) T_c."""
    ratio, goal = 0.5, 0.1
    law = replace(LAW, creep_ratio=ratio, creep_s=0.4, relaxation_s=0.01, density_kg_m=0.005)
    times, angles = hinge(law, 0.0, 2.0, drag=20.0, natural=goal)
    late = times > 0.2
    expected = goal * (1.0 - ratio / (1.0 + ratio) * np.exp(-times[late] / ((1.0 + ratio) * 0.4)))
    assert angles[late] == pytest.approx(expected, abs=0.01 * goal)


def test_a_rod_has_crept_to_the_shape_from_which_it_starts() -> None:
    """Its branch holds it there: the first pull towards straight is that of B alone."""
    _, plain = hinge(LAW, 0.1, 0.02)
    _, crept = hinge(replace(LAW, creep_ratio=3.0, creep_s=1e6), 0.1, 0.02)
    assert 0.1 - crept[2] == pytest.approx(0.1 - plain[2], rel=0.01)


def test_a_level_rod_falls_at_last_at_the_speed_of_its_drag() -> None:
    lattice = line(10, LENGTH)
    start = along(lattice)
    law = replace(LAW, drag_normal_per_m=2.0)
    times = np.linspace(0.0, 1.0, 21)
    path, _ = run(problem(lattice, law, gravity=FALL, frames=21), start, times, 1e-3)
    last = np.sqrt(9.81 / 2.0)
    exact = -np.log(np.cosh(9.81 * times / last)) / 2.0
    assert path[:, :, 2] == pytest.approx(np.tile(exact, (11, 1)).T, abs=2e-3)  # of first order in the step


def test_drag_across_the_rod_does_not_slow_it_along_itself() -> None:
    lattice = line(10, LENGTH)
    start = along(lattice, (0.0, 0.0, -1.0))
    law = replace(LAW, drag_normal_per_m=2.0)
    path, _ = run(problem(lattice, law, gravity=FALL), start, np.array([0.0, 0.5]), 1e-3)
    assert path[-1] - start == pytest.approx(np.tile(0.125 * FALL, (11, 1)), abs=1e-9)


def swing(law: CableLaw = LAW, times: np.ndarray | None = None, dt: float | None = 2e-3) -> np.ndarray:
    """Path of a branched cable that is let fall from a bent start, held at its first edge."""
    lattice = tree()
    start = along(lattice)
    start[:, 1] = 0.05 * np.sin(8.0 * np.arange(len(start)))
    times = np.linspace(0.0, 0.6, 13) if times is None else times
    natural = uniform(lattice, 1.0, -2.0, 0.5)
    one = problem(lattice, law, natural=natural, gravity=FALL, edges=(1,), frames=len(times))
    return run(one, start, times, dt, held=still([0, 1], start, len(times)))[0]


@pytest.mark.parametrize("idle", [{"friction_onset_per_m": 0.3}, {"creep_s": 0.2}])
def test_a_loss_of_no_strength_changes_no_bit(idle: dict[str, float]) -> None:
    assert np.array_equal(swing(), swing(replace(LAW, **idle)))


def test_frames_of_other_lengths_do_not_change_the_motion() -> None:
    even = swing(times=np.linspace(0.0, 0.6, 121), dt=1e-3)[-1]
    uneven = swing(times=np.array([0.0, 0.0104, 0.0105, 0.111, 0.2107, 0.3502, 0.6]), dt=1e-3)[-1]
    coarse = swing(times=np.linspace(0.0, 0.6, 121), dt=2e-3)[-1]
    assert np.abs(uneven - even).max() < np.abs(coarse - even).max()


@dataclass
class Idle:
    """A term that adds nothing, and counts how often it was asked to."""

    launches: int = 0
    frequency_rad_s: float = 0.0
    friction_per_s: float = 0.0

    def bind(self, problem: Problem) -> Idle:
        return self

    def begin(self, times: np.ndarray) -> None:
        return None

    def pace(self, time_step_s: float) -> None:
        return None

    def check(self, time_s: float) -> None:
        return None

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        self.launches += 1


class Push(Idle):
    """A constant force on every node [N], (n, 3)."""

    def __init__(self, force: np.ndarray) -> None:
        super().__init__()
        self.force = wp.array(force.reshape(-1), dtype=wp.float64)

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        wp.copy(force, self.force)


def cases(count: int) -> tuple[list[Problem], np.ndarray, np.ndarray, HeldNodes]:
    """So many ropes that differ in every number, their start, times and grips."""
    lattice = line(12, LENGTH)
    start, times = along(lattice), np.linspace(0.0, 0.4, 9)
    problems = [
        problem(
            lattice,
            replace(LAW, bending_n_m2=1e-3 * (1 + k), relaxation_s=0.01 * k, friction_per_m=0.2 * k,
                    creep_ratio=0.1 * k, drag_normal_per_m=0.3 * k),
            natural=uniform(lattice, 1.0 * k, 2.0, 0.3), gravity=FALL, edges=(1,), frames=9, drag_per_s=0.2 * k,
        )
        for k in range(count)
    ]  # fmt: skip
    return problems, start, times, still([0, 1], start, 9)


def test_ropes_side_by_side_run_as_alone_to_the_bit() -> None:
    problems, start, times, held = cases(3)
    step = DiscreteRods(problems).time_step_s
    together = DiscreteRods(problems, step).run(start, np.zeros_like(start), [held], times)
    for one, found in zip(problems, together, strict=True):
        alone = DiscreteRods([one], step).run(start, np.zeros_like(start), [held], times)[0]
        assert np.array_equal(alone, found)
    assert not np.array_equal(together[0], together[1])


def test_a_run_substep_by_substep_is_the_run_as_a_whole() -> None:
    problems, start, times, held = cases(3)
    idle = Idle()
    whole = DiscreteRods(problems[2:]).run(start, np.zeros_like(start), [held], times)[0]
    one = replace(problems[2], terms=(idle,))
    stepped = DiscreteRods([one]).run(start, np.zeros_like(start), [held], times)[0]
    assert idle.launches == 1, "a substep is recorded once and replayed"
    assert stepped == pytest.approx(whole, abs=1e-13)


def test_a_term_that_pushes_as_gravity_does_is_gravity() -> None:
    problems, start, times, held = cases(2)
    weight = problems[1].nodal_mass()[:, None] * FALL
    whole = DiscreteRods(problems[1:]).run(start, np.zeros_like(start), [held], times)[0]
    one = replace(problems[1], gravity_m_s2=WEIGHTLESS, terms=(Push(weight),))
    pushed = DiscreteRods([one]).run(start, np.zeros_like(start), [held], times)[0]
    assert pushed == pytest.approx(whole, abs=1e-11)


def test_stretch_waves_alone_are_damped_by_the_engine() -> None:
    """Its one own loss: a mode of stretch of omega decays at omega^2 / 2 times a millisecond."""
    lattice = line(20)
    start = along(lattice)
    omega = np.pi * np.sqrt(LAW.stretching_n / LAW.density)
    velocity = np.zeros_like(start)
    velocity[:, 0] = -1e-2 * np.cos(np.pi * lattice.distances)
    times = np.linspace(0.0, 0.03, 61)
    path, _ = run(problem(lattice, frames=61), start, times, 2e-5, velocity)
    found = ringing(times, path[:, -1, 0] - start[-1, 0], omega)
    rate = 0.5 * discrete_rods._STRETCH_RELAXATION_S * omega**2
    assert found[1] == pytest.approx(rate, rel=0.03)
    assert found[0] == pytest.approx(np.sqrt(omega**2 - rate**2), rel=0.01)
