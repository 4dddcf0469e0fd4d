"""Contact of ropes and sheets with themselves against closed forms: weight, Coulomb's law, momentum, energy."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import GRAVITY, NeoHookean, RodLaw, SheetLaw, rest_nodes
from pieces import crossings, in_pieces, laid, still

from physworld.engine.gradients.adjoint import Adjoint
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import Problem
from physworld.engine.terms.contact import GroundContact
from physworld.engine.thin.self_contact import SelfContact
from physworld.engine.total.batch import Batch
from physworld.engine.total.energy import run_with_ledger
from physworld.engine.total.formulation import Run, TotalLagrangian
from physworld.errors import ContactFailed, NotDifferentiable, SceneUnsupported

pytestmark = pytest.mark.slow

G = 9.81
X, Y = np.eye(3)[0], np.eye(3)[1]
DIAMETER = 0.008
ROD = RodLaw(stretching_n=200.0, bending_n_m2=0.05, relaxation_s=1e-4, density_kg_m=0.05)
ROPE = RodLaw(stretching_n=200.0, bending_n_m2=1e-4, relaxation_s=2e-3, density_kg_m=0.05)
STRIP = RodLaw(stretching_n=80.0, bending_n_m2=1e-5, density_kg_m=0.05)
CLOTH = SheetLaw(membrane_n_m=300.0, bending_n_m=2e-5, relaxation_s=5e-4, density_kg_m2=0.2)
NOBODY = np.empty(0, dtype=int)


def across_two_rails(friction: float) -> tuple[Lattice, np.ndarray, np.ndarray, np.ndarray, SelfContact]:
    """A straight rod on two held ones: lattice, nodes, those of the rod and those that are held, contact."""
    counts, dx = ((8,), (8,), (11,)), 0.025
    lattice, (first, second, rod) = in_pieces(counts, dx)
    corners = np.array([[0.0, -0.06, 0.0], [0.0, 0.067, 0.0], [0.06, -0.5 * 11 * dx, DIAMETER]])
    nodes = laid(lattice, [first, second, rod], corners, [X[None], X[None], Y[None]])
    return lattice, nodes, rod, np.concatenate([first, second]), SelfContact(DIAMETER, friction)


def centre(solver: TotalLagrangian, nodes: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Path of the centre of mass of some nodes, (T, 3)."""
    mass = solver.mass[own]
    return np.einsum("n,tni->ti", mass, nodes[:, own]) / mass.sum()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("degrees", [15.0, 25.0])
def test_a_rod_across_two_rails_slides_when_its_weight_exceeds_coulombs_limit(
    axis: int, degrees: float
) -> None:
    friction, seconds = 0.364, 0.2  # tan 20 degrees
    lattice, nodes, rod, rails, contact = across_two_rails(friction)
    tilt = np.radians(degrees)
    gravity = np.array([0.0, 0.0, -G * np.cos(tilt)])
    gravity[axis] = G * np.sin(tilt)
    solver = TotalLagrangian(Problem(lattice, ROD, nodes, gravity, terms=(contact,)))
    times = np.linspace(0.0, seconds, 5)
    moved = solver.run(nodes, 0 * nodes, still(rails, nodes, 5), times)
    way = centre(solver, moved, rod)[:, axis] - centre(solver, moved, rod)[0, axis]
    if degrees < 20:
        assert 0 < way[-1] < 5e-5  # the elastic slip, and that of the first impact
    else:
        expected = 0.5 * G * (np.sin(tilt) - friction * np.cos(tilt)) * times**2
        assert way[-1] == pytest.approx(expected[-1], rel=0.015)


def test_crossing_rods_rest_a_diameter_apart_less_what_their_weight_presses() -> None:
    lattice, nodes, rod, rails, contact = across_two_rails(0.3)
    solver = TotalLagrangian(Problem(lattice, ROD, nodes, GRAVITY, drag_per_s=20.0, terms=(contact,)))
    moved = solver.run(nodes, 0 * nodes, still(rails, nodes, 2), np.array([0.0, 1.0]))
    weight = solver.mass[rod].sum() * G
    begin = lattice.node_coordinates[rod, 0].min() + 0.5 * lattice.spacing[0]
    over = begin + 0.5 * 11 * 0.025 + np.array([-0.06, 0.067])
    above = (lattice.interpolation(over[:, None]) @ moved[-1])[:, 2]
    sunk = DIAMETER - above.mean()
    assert sunk == pytest.approx(0.5 * weight / (ROD.stretching_n / (2 * 0.025)), rel=0.05)
    assert sunk < 0.01 * DIAMETER


@pytest.mark.parametrize("law", [ROPE, CLOTH], ids=["rope", "sheet"])
def test_layers_rest_a_thickness_apart_less_the_penalty_of_two_cells(law) -> None:
    thickness, dx = 0.004, 0.02
    count = (10,) if law is ROPE else (6, 5)
    lattice, (low, top) = in_pieces((count, count), dx)
    axes = np.eye(3)[: len(count)]
    nodes = laid(lattice, [low, top], np.array([[0, 0, 0], [0, 0, thickness + 1e-3]]), [axes, axes])
    contact = SelfContact(thickness, 0.3)
    solver = TotalLagrangian(Problem(lattice, law, nodes, GRAVITY, terms=(contact,)))
    moved = solver.run(nodes, 0 * nodes, still(low, nodes, 3), np.array([0.0, 0.45, 0.5]))
    lattice_middle = lattice.node_coordinates[top].mean(axis=0)
    height = (lattice.interpolation(lattice_middle[None]) @ moved[-1])[0, 2]
    assert height == pytest.approx(thickness - 2 * G * (dx / law.wave_speed_m_s) ** 2, abs=1e-6)
    assert np.abs(moved[-1] - moved[-2]).max() < 1e-8


def test_a_sheet_slides_over_itself_with_coulombs_force() -> None:
    thickness, dx, friction, speed = 0.002, 0.02, 0.4, 0.5
    lattice, (low, top) = in_pieces(((14, 6), (5, 4)), dx)
    axes = np.eye(3)[:2]
    sunk = 2 * G * (dx / CLOTH.wave_speed_m_s) ** 2
    corners = np.array([[0, 0, 0], [0.03, 0.013, thickness - sunk]])
    nodes = laid(lattice, [low, top], corners, [axes, axes])
    velocity = np.zeros_like(nodes)
    velocity[top, 0] = speed
    contact = SelfContact(thickness, friction)
    solver = TotalLagrangian(Problem(lattice, CLOTH, nodes, GRAVITY, terms=(contact,)))
    times = np.linspace(0, 0.3, 4)
    way = centre(solver, solver.run(nodes, velocity, still(low, nodes, 4), times), top)[:, 0]
    assert way[-1] - way[0] == pytest.approx(speed**2 / (2 * friction * G), rel=0.02)
    assert abs(way[-1] - way[-2]) < 1e-5


def closing(arc_rad: float = 5.3, offset: float = 0.0) -> tuple[Lattice, np.ndarray, np.ndarray]:
    """A free strip bent to an open ring whose ends fly at each other: lattice, nodes, velocities."""
    length = 0.6
    lattice = box_lattice(np.zeros(1), np.array([length]), (24,))
    along = lattice.node_coordinates[:, 0] / length - 0.5
    radius = length / arc_rad
    nodes = np.zeros((len(along), 3))
    nodes[:, 0], nodes[:, 1] = radius * np.cos(arc_rad * along), radius * np.sin(arc_rad * along)
    nodes[:, 2] = offset * along**3
    velocity = np.zeros_like(nodes)
    velocity[:, 1] = -8.0 * along**3
    return lattice, nodes, velocity + np.array([0.3, 0.2, 0.1])


@pytest.mark.parametrize(("friction", "offset"), [(0.0, 0.0), (0.0, 0.02), (0.5, 0.02)])
def test_two_ends_of_a_free_strip_that_meet_keep_its_momentum(friction: float, offset: float) -> None:
    lattice, nodes, velocity = closing(offset=offset)
    contact = SelfContact(DIAMETER, friction)
    solver = TotalLagrangian(Problem(lattice, STRIP, rest_nodes(lattice), np.zeros(3), terms=(contact,)))
    times = np.linspace(0, 0.2, 21)
    run = Run(solver, nodes, velocity, still(NOBODY, nodes, 21), times)
    mass, linear, angular = solver.mass[:, None], [], []
    for frame in range(20):
        place, speed = run.advance(frame), run.v.numpy().reshape(-1, 3)
        linear.append((mass * speed).sum(axis=0))
        angular.append(np.cross(place, mass * speed).sum(axis=0))
    assert solver.terms[0].deepest_m > 1e-5  # they did meet
    scale = float((mass[:, 0] * np.linalg.norm(velocity, axis=1)).sum())
    assert np.ptp(linear, axis=0).max() < 1e-12 * scale
    if friction == 0:
        assert np.ptp(angular, axis=0).max() < 1e-12 * scale
    else:  # at most the couple of friction: a diameter times its impulse
        assert np.ptp(angular, axis=0).max() < DIAMETER * scale


@pytest.mark.parametrize(("damping", "offset"), [(0.0, 0.005), (0.0, 0.04), (1.0, 0.005)])
def test_a_collision_creates_no_energy_and_an_elastic_one_takes_little(damping: float, offset: float) -> None:
    lattice, nodes, velocity = closing(offset=offset)
    contact = SelfContact(DIAMETER, 0.0, damping=damping)
    problem = Problem(lattice, STRIP, rest_nodes(lattice), np.zeros(3), terms=(contact,))
    times = np.linspace(0, 0.2, 51)
    _, ledger = run_with_ledger(problem, nodes, velocity, still(NOBODY, nodes, 51), times)
    taken = -ledger.term_work / ledger.turnover
    assert taken.max() > (0.02 if offset < 0.01 else 1e-3)  # they did meet; at the larger offset they graze
    assert taken.min() > -0.002
    assert taken[-1] < 0.01 if damping == 0 else taken[-1] > 0.05
    assert np.abs(ledger.lost).max() < 0.03 * ledger.turnover


def folded(lattice: Lattice, low: float, radius: float, height: float) -> np.ndarray:
    """A sheet that lies, turns back over half a circle, and lies over itself."""
    along = lattice.node_coordinates[:, 0]
    angle = np.clip((along - low) / radius, 0, np.pi)
    nodes = rest_nodes(lattice)
    nodes[:, 0] = np.minimum(along, low) + radius * np.sin(angle)
    nodes[:, 0] -= np.maximum(along - low - np.pi * radius, 0)
    nodes[:, 2] = radius * (1 - np.cos(angle)) + height
    return nodes


@pytest.mark.parametrize("touching", [True, False])
def test_a_sheet_that_falls_on_itself_does_not_pass_through(touching: bool) -> None:
    thickness = 2e-3
    lattice = box_lattice(np.zeros(2), np.array([0.3, 0.1]), (24, 8))
    start = folded(lattice, 0.12, 0.02, 0.5 * thickness)
    terms: tuple = (GroundContact(0.0, 0.5, 0.5 * thickness),)
    if touching:
        terms += (SelfContact(thickness, 0.3),)
    problem = Problem(lattice, CLOTH, rest_nodes(lattice), GRAVITY, drag_per_s=0.5, terms=terms)
    solver = TotalLagrangian(problem)
    nodes = solver.run(start, 0 * start, still(NOBODY, start, 7), np.linspace(0, 0.42, 7))
    found = [crossings(lattice, frame, 0.04) for frame in nodes]
    top = (lattice.interpolation(np.array([[0.27, 0.05]])) @ nodes[-1])[0, 2]
    if touching:
        assert found == [0] * 7
        assert top == pytest.approx(1.5 * thickness, abs=5e-5)
    else:
        assert max(found) > 20
        assert top < thickness


def test_a_coil_of_rope_falls_on_itself_and_rests_a_diameter_apart() -> None:
    diameter, length, radius, pitch = 0.012, 1.0, 0.04, 0.06
    lattice = box_lattice(np.zeros(1), np.array([length]), (64,))
    turn = lattice.node_coordinates[:, 0] / np.hypot(radius, pitch / (2 * np.pi))
    start = np.stack(
        [radius * np.cos(turn), radius * np.sin(turn), pitch / (2 * np.pi) * turn + 0.02], axis=1
    )
    ground = GroundContact(0.0, 0.5, 0.5 * diameter)
    terms = (ground, SelfContact(diameter, 0.3))
    problem = Problem(lattice, ROPE, rest_nodes(lattice), GRAVITY, drag_per_s=0.5, terms=terms)
    solver = TotalLagrangian(problem)
    nodes = solver.run(start, 0 * start, still(NOBODY, start, 7), np.linspace(0, 0.9, 7))
    along = np.linspace(0, length, 801)
    far = np.abs(along[:, None] - along) > 2 * max(diameter, length / 64)
    for frame in nodes[2:]:
        curve = lattice.interpolation(along[:, None]) @ frame
        nearest = np.linalg.norm(curve[:, None] - curve, axis=-1)[far].min()
        assert nearest == pytest.approx(diameter, rel=0.01)
    assert solver.terms[1].pairs > 20


@pytest.mark.parametrize("touching", [True, False])
def test_an_overhand_knot_tightens_and_does_not_come_undone(touching: bool) -> None:
    diameter, cells, pull = 0.012, 48, 0.15
    t = np.linspace(-2.35, 2.35, 4001)
    curve = np.stack([t**3 - 3 * t, t**4 - 4 * t**2, 0.2 * t**5 - 2 * t], axis=1) * [0.035, 0.025, 0.03]
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    lattice = box_lattice(np.zeros(1), along[-1:], (cells,))
    places = lattice.node_coordinates[:, 0]
    start = np.stack([np.interp(places, along, curve[:, k]) for k in range(3)], axis=1)
    start[0], start[-1] = 2 * start[1] - start[2], 2 * start[-2] - start[-3]
    terms = (SelfContact(diameter, 0.3),) if touching else ()
    problem = Problem(lattice, ROPE, rest_nodes(lattice), np.zeros(3), drag_per_s=3.0, terms=terms)
    times = np.linspace(0, 1.2, 13)
    held = still(np.r_[0:3, len(start) - 3 : len(start)], start, 13)
    axis = (start[-2] - start[1]) / np.linalg.norm(start[-2] - start[1])
    for ends, sign in ((slice(0, 3), -1.0), (slice(3, 6), 1.0)):
        held.positions[:, ends] += sign * pull * times[:, None, None] * axis
        held.velocities[:, ends] = sign * pull * axis
    nodes = TotalLagrangian(problem).run(start, 0 * start, held, times)
    fine = np.linspace(0, along[-1], 601)
    row, far = lattice.interpolation(fine[:, None]), np.abs(fine[:, None] - fine) > 4 * along[-1] / cells
    nearest = [np.linalg.norm((c := row @ x)[:, None] - c, axis=-1)[far].min() for x in nodes]
    if touching:
        assert min(nearest[1:]) > 0.97 * diameter
        assert nearest[-1] < 1.03 * diameter
    else:
        assert min(nearest) < 0.5 * diameter


def test_a_stack_of_sheets_is_stable_and_comes_to_rest() -> None:
    thickness, dx, layers = 0.003, 0.02, 5
    lattice, own = in_pieces(((5, 4),) * layers, dx)
    corners = np.array([[5e-4 * k, 3e-4 * k, thickness * (0.5 + k) + 0.002 * k] for k in range(layers)])
    nodes = laid(lattice, own, corners, [np.eye(3)[:2]] * layers)
    terms = (GroundContact(0.0, 0.5, 0.5 * thickness), SelfContact(thickness, 0.4))
    solver = TotalLagrangian(Problem(lattice, CLOTH, nodes, GRAVITY, drag_per_s=10.0, terms=terms))
    moved = solver.run(nodes, 0 * nodes, still(NOBODY, nodes, 3), np.array([0.0, 0.75, 0.8]))
    heights = np.array([moved[-1][k, 2].mean() for k in own])
    assert heights == pytest.approx(thickness * (0.5 + np.arange(layers)), abs=1e-4)
    assert np.abs(moved[-1] - moved[-2]).max() < 1e-6


def test_a_body_that_does_not_touch_itself_moves_as_without_it() -> None:
    lattice, nodes, velocity = closing(arc_rad=3.0)
    rest = rest_nodes(lattice)
    with_it = TotalLagrangian(Problem(lattice, STRIP, rest, GRAVITY, terms=(SelfContact(DIAMETER, 0.3),)))
    without = TotalLagrangian(Problem(lattice, STRIP, rest, GRAVITY), with_it.time_step_s)
    times, held = np.linspace(0, 0.1, 4), still(NOBODY, nodes, 4)
    paths = [solver.run(nodes, velocity, held, times) for solver in (with_it, without)]
    assert np.array_equal(*paths)
    assert with_it.terms[0].searches > 1
    assert with_it.terms[0].deepest_m == 0


def test_runs_repeat_and_bodies_side_by_side_touch_themselves_as_alone() -> None:
    lattice, nodes, velocity = closing(offset=0.02)
    rest, times = rest_nodes(lattice), np.linspace(0, 0.15, 4)
    held = still(NOBODY, nodes, 4)
    problems = [
        Problem(lattice, STRIP, rest, np.zeros(3), terms=(SelfContact(DIAMETER, mu),)) for mu in (0.0, 0.5)
    ]
    alone = [TotalLagrangian(problem) for problem in problems]
    expected = [solver.run(nodes, velocity, held, times) for solver in alone]
    assert np.array_equal(alone[1].run(nodes, velocity, held, times), expected[1])
    together = Batch(problems).run([nodes] * 2, [velocity] * 2, [held] * 2, [times] * 2)
    assert all(np.array_equal(a, b) for a, b in zip(together, expected, strict=True))
    assert not np.array_equal(*expected)


def test_what_is_too_fast_for_its_cells_ends_the_run_and_what_is_held_does_not_touch() -> None:
    lattice, nodes, rod, rails, contact = across_two_rails(0.0)
    nodes[rod, 2] += 0.02
    velocity = np.zeros_like(nodes)
    velocity[rod, 2] = -80.0
    times = np.linspace(0, 2e-3, 9)
    problem = Problem(lattice, ROD, nodes, np.zeros(3), terms=(contact,))
    with pytest.raises(ContactFailed, match=r"into itself .* 0\.008 m thick"):
        TotalLagrangian(problem).run(nodes, velocity, still(rails, nodes, 9), times)
    every = np.arange(len(nodes))
    held = still(every, nodes, 9)
    held.positions[:, rod, 2] -= 20.0 * times[:, None]
    held.velocities[:, rod, 2] = -20.0
    both = Problem(lattice, ROD, nodes, np.zeros(3), terms=(SelfContact(DIAMETER, 0.0, held=every),))
    solver = TotalLagrangian(both)
    solver.run(nodes, velocity, held, times)
    assert solver.terms[0].deepest_m == 0


def test_what_starts_nearer_than_its_thickness_is_not_thrown_apart() -> None:
    lattice, nodes, rod, rails, contact = across_two_rails(0.0)
    nodes[rod, 2] -= 0.5 * DIAMETER
    problem = Problem(lattice, ROD, nodes, np.zeros(3), terms=(contact,))
    moved = TotalLagrangian(problem).run(nodes, 0 * nodes, still(rails, nodes, 2), np.array([0.0, 0.1]))
    assert np.abs(moved[-1] - nodes).max() < 1e-12


def test_solids_thin_layers_and_gradients_are_refused() -> None:
    block = box_lattice(np.zeros(3), np.ones(3), (2, 2, 2))
    solid = Problem(block, NeoHookean(1e5), block.node_coordinates, GRAVITY, terms=(SelfContact(0.1, 0.3),))
    with pytest.raises(SceneUnsupported, match="a solid touches itself in the updated Lagrangian form only"):
        TotalLagrangian(solid)
    lattice, nodes, _ = closing()
    thin = Problem(lattice, STRIP, nodes, GRAVITY, terms=(SelfContact(1e-4, 0.3),))
    with pytest.raises(SceneUnsupported, match=r"0\.0001 m thick on cells of 0\.025 m: at least 0\.00025 m"):
        TotalLagrangian(thin)
    rough = Problem(lattice, STRIP, nodes, GRAVITY, terms=(SelfContact(DIAMETER, -0.1),))
    with pytest.raises(ValueError, match=r"friction -0\.1"):
        TotalLagrangian(rough)
    sound = Problem(lattice, STRIP, nodes, GRAVITY, terms=(SelfContact(DIAMETER, 0.3),))
    with pytest.raises(NotDifferentiable, match="SelfContact, has no derivative"):
        Adjoint(sound)
