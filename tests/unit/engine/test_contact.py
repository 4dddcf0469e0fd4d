"""Contact against closed forms: Coulomb's law, Hertz's, impulse and momentum, work and energy."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import GRAVITY, NeoHookean, RodLaw, SheetLaw, rest_nodes, still_clamp

from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.colliders import Collider
from physworld.engine.terms.colliders_path import RigidPath
from physworld.engine.terms.contact import ColliderContact, GroundContact, ground, touching
from physworld.engine.total.energy import run_with_ledger
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import ContactFailed
from physworld.shapes import sdf

pytestmark = pytest.mark.slow

LAW = NeoHookean(2e5, 0.3, 20.0, 1000.0)
BLOCK = box_lattice(np.array([-0.05, -0.05, 0.0]), np.array([0.1, 0.1, 0.05]), (4, 4, 2))
MASS = 0.5
G = 9.81

ROCKING = 0.03
"""A soft block on a penalty rocks, and for moments a part of it presses less: share of a friction force."""
HERTZ = 0.10
"""Two and a half cells a contact radius: measured 2.5 to 8 %."""


def line(start: tuple[float, ...], end: tuple[float, ...], seconds: float) -> RigidPath:
    return RigidPath(np.array([0.0, seconds]), np.array([start, end]), np.repeat(np.eye(3)[None], 2, axis=0))


def simulate(
    lattice: Lattice, law, terms, times, *, gravity=GRAVITY, start=None, velocity=None, held=None
) -> tuple[TotalLagrangian, np.ndarray, np.ndarray]:
    """Solver, paths of the centre of mass (T, 3), and impulses of the terms at the frames (T, terms, 3)."""
    rest = rest_nodes(lattice)
    x = rest if start is None else start
    v = np.zeros_like(rest) if velocity is None else np.broadcast_to(velocity, rest.shape)
    solver = TotalLagrangian(Problem(lattice, law, rest, np.asarray(gravity, dtype=float), terms=terms))
    impulses = [np.zeros((len(terms), 3))]

    def keep(frame: int, frames: int) -> None:
        impulses.append(np.array([term.impulse_n_s for term in solver.terms]))

    held = still_clamp(lattice, rest, len(times), clamped=False) if held is None else held
    nodes = solver.run(x, np.array(v), held, times, keep)
    centre = np.einsum("n,tni->ti", solver.mass, nodes) / solver.mass.sum()
    return solver, nodes if lattice.dim < 3 else centre, np.array(impulses)


@pytest.mark.parametrize("friction", [0.3, 0.6])
def test_a_pushed_block_resists_with_coulombs_force(friction: float) -> None:
    pusher = Collider("pusher", sdf.box((0.05, 0.2, 0.08)), line((-0.08, 0, 0.06), (0.07, 0, 0.06), 1.0), 0.0)
    times = np.linspace(0, 1, 41)
    terms = (GroundContact(0.0, friction), ColliderContact(pusher))
    _, centre, impulses = simulate(BLOCK, LAW, terms, times)
    force = (impulses[40] - impulses[20]) / 0.5
    assert force[0, 2] + force[1, 2] == pytest.approx(MASS * G, rel=ROCKING)
    assert force[1, 0] == pytest.approx(friction * MASS * G, rel=2 * ROCKING)
    assert centre[40, 0] - centre[20, 0] == pytest.approx(0.075, rel=0.02)


@pytest.mark.parametrize(("degrees", "friction"), [(20.0, 0.5), (35.0, 0.9)])
def test_a_block_on_a_gentle_slope_sticks_and_does_not_creep(degrees: float, friction: float) -> None:
    slope = G * np.array([np.sin(np.radians(degrees)), 0.0, -np.cos(np.radians(degrees))])
    times = np.linspace(0, 2, 21)
    _, centre, _ = simulate(BLOCK, LAW, (GroundContact(0.0, friction),), times, gravity=slope)
    assert abs(centre[20, 0] - centre[10, 0]) < 2e-4  # free, it would slide 5 m


def test_a_block_on_a_steep_slope_slides_at_coulombs_acceleration() -> None:
    angle, friction, times = np.radians(40.0), 0.5, np.linspace(0, 0.5, 21)
    slope = G * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    _, centre, _ = simulate(BLOCK, LAW, (GroundContact(0.0, friction),), times, gravity=slope)
    slid = 0.5 * G * (np.sin(angle) - friction * np.cos(angle)) * 0.5**2
    assert centre[-1, 0] == pytest.approx(slid, rel=ROCKING)


def test_a_plate_that_presses_drags_a_block_along_until_its_friction_gives_way() -> None:
    """On a frictionless ground; the plate's own pull is at most mu times what it presses with."""
    knots = np.array([0.0, 0.2, 0.4, 0.9])
    times = np.linspace(0, 0.9, 37)

    def travel(speed: float, friction: float) -> float:
        places = np.array([[0, 0, 0.08], [0, 0, 0.068], [0, 0, 0.068], [0.5 * speed, 0, 0.068]])
        plate = Collider(
            "plate", sdf.box((0.6, 0.3, 0.04)), RigidPath(knots, places, np.stack([np.eye(3)] * 4)), friction
        )
        terms = (GroundContact(0.0, 0.0), ColliderContact(plate))
        return float(simulate(BLOCK, LAW, terms, times)[1][-1, 0])

    assert travel(0.1, 0.5) == pytest.approx(0.05, abs=0.01)
    assert travel(0.1, 0.0) == pytest.approx(0.0, abs=1e-3)


def test_what_a_collider_gives_is_what_the_body_gets_and_nothing_is_held_back() -> None:
    """The ball comes, presses and leaves: the body keeps the momentum of the impulse; adhesion would brake it."""
    places = np.array([[-0.09, 0, 0.03], [-0.07, 0.005, 0.03], [-0.12, 0, 0.03]])
    turns = np.repeat(np.eye(3)[None], 3, axis=0)
    ball = Collider("ball", sdf.sphere(0.03), RigidPath(np.array([0.0, 0.05, 0.1]), places, turns), 0.3)
    times = np.linspace(0, 0.3, 61)
    _, centre, impulses = simulate(BLOCK, LAW, (ColliderContact(ball),), times, gravity=np.zeros(3))
    momentum = MASS * (centre[60] - centre[40]) / (times[60] - times[40])
    assert momentum == pytest.approx(impulses[-1, 0], abs=1e-8)
    assert momentum[0] > 0.1
    assert (np.diff(impulses[:, 0, 0]) >= 0).all()


def test_a_frictionless_collision_conserves_energy_and_a_pusher_gives_what_it_works() -> None:
    law, rest, times = NeoHookean(2e5, 0.3, 0.0, 1000.0), rest_nodes(BLOCK), np.linspace(0, 0.2, 41)
    still = Collider("ball", sdf.sphere(0.1), RigidPath.still((0.0, 0.0, -0.105)), 0.0)
    velocity = np.broadcast_to([0.0, 0.0, -0.8], rest.shape).copy()
    held = still_clamp(BLOCK, rest, 41, clamped=False)
    problem = Problem(BLOCK, law, rest, np.zeros(3), terms=(ColliderContact(still),))
    _, ledger = run_with_ledger(problem, rest, velocity, held, times)
    assert np.abs(ledger.lost).max() < 0.005 * ledger.kinetic[0]
    assert ledger.term_work[-1] == pytest.approx(0.0, abs=0.005 * ledger.kinetic[0])
    pusher = Collider("pusher", sdf.box((0.04, 0.2, 0.2)), line((-0.08, 0, 0.03), (0.02, 0, 0.03), 0.1), 0.0)
    problem = Problem(BLOCK, law, rest, np.zeros(3), terms=(ColliderContact(pusher),))
    _, ledger = run_with_ledger(problem, rest, 0 * velocity, held, times)
    assert ledger.term_work[-1] > 0.1
    assert np.abs(ledger.lost).max() < 0.005 * ledger.term_work[-1]


def test_friction_only_takes_energy() -> None:
    rest, times = rest_nodes(BLOCK), np.linspace(0, 0.4, 41)
    problem = Problem(BLOCK, LAW, rest, GRAVITY, terms=(GroundContact(0.0, 0.5),))
    velocity = np.broadcast_to([1.0, 0.0, 0.0], rest.shape).copy()
    _, ledger = run_with_ledger(problem, rest, velocity, still_clamp(BLOCK, rest, 41, clamped=False), times)
    assert ledger.term_work[-1] == pytest.approx(-0.5 * MASS, rel=0.05)
    assert ledger.kinetic[-1] < 1e-3 * ledger.kinetic[0]


def boussinesq(x: np.ndarray, load: float, modulus: float, ratio: float) -> np.ndarray:
    """Displacements (n, 3) of a half space z < 0 under a normal point load at the origin (Johnson, 3.2)."""
    r, z = np.hypot(x[:, 0], x[:, 1]), -x[:, 2]
    far = np.hypot(r, z)
    scale = load * (1 + ratio) / (2 * np.pi * modulus * far)
    radial = scale * (z * r / far**2 - (1 - 2 * ratio) * r / (far + z))
    sunk = -scale * (2 * (1 - ratio) + z**2 / far**2)
    return np.concatenate([(radial / np.maximum(r, 1e-12))[:, None] * x[:, :2], sunk[:, None]], axis=1)


def test_a_sphere_pressed_into_a_block_follows_hertz() -> None:
    """The block is a piece of a half space: its far sides move as under a point load of Hertz's size."""
    modulus, ratio, dx, count = 1e5, 0.3, 0.01, 14
    law = NeoHookean(modulus, ratio, 0.0, 1000.0)
    size = count * dx
    lattice = box_lattice(
        np.array([-size / 2, -size / 2, -size / 2]), np.array([size, size, size / 2]), (14, 14, 7)
    )
    contact_radius = 2.5 * dx
    radius = 40 * contact_radius
    depth = contact_radius**2 / radius
    stiff = 4 / 3 * modulus / (1 - ratio**2) * np.sqrt(radius)
    rest = rest_nodes(lattice)
    far = (lattice.cells[:, :2] < 1).any(axis=1) | (lattice.cells[:, :2] >= count - 1).any(axis=1)
    nodes = np.unique(lattice.cell_nodes[far | (lattice.cells[:, 2] < 1)])
    start = rest.copy()
    start[nodes] += boussinesq(rest[nodes], stiff * depth**1.5, modulus, ratio)
    times = np.linspace(0, 0.8, 17)
    held = HeldNodes(nodes, np.repeat(start[nodes][None], 17, axis=0), np.zeros((17, len(nodes), 3)))
    ball = Collider("ball", sdf.sphere(radius), RigidPath.still((0.0, 0.0, radius - depth)), 0.0)
    problem = Problem(lattice, law, rest, np.zeros(3), drag_per_s=30.0, terms=(ColliderContact(ball),))
    solver, impulses = TotalLagrangian(problem), []
    out = solver.run(
        start, 0 * start, held, times, lambda *_: impulses.append(solver.terms[0].impulse_n_s[2])
    )
    force = -(impulses[-1] - impulses[-2]) / (times[-1] - times[-2])
    sunk = -float((lattice.interpolation(np.zeros((1, 3))) @ out[-1])[0, 2])
    assert force == pytest.approx(stiff * sunk**1.5, rel=HERTZ)
    assert 0.75 * depth < sunk < 0.9 * depth  # the penalty is one more cell, and gives in


SHEET = box_lattice(np.zeros(2), np.array([0.2, 0.2]), (6, 6))
CLOTH = SheetLaw(100.0, 1e-5, density_kg_m2=0.3)
ROPE_LATTICE = box_lattice(np.zeros(1), np.array([0.5]), (16,))
ROPE = RodLaw(stretching_n=40.0, bending_n_m2=1e-4, density_kg_m=0.05)
THIN = {"sheet": (SHEET, CLOTH, 5e-4), "rope": (ROPE_LATTICE, ROPE, 4e-3)}


@pytest.mark.parametrize("name", THIN)
def test_a_thin_body_dropped_on_the_ground_comes_to_rest_at_its_own_thickness(name: str) -> None:
    lattice, law, offset = THIN[name]
    start = rest_nodes(lattice) + np.array([0.0, 0.0, offset + 0.05])
    contact = GroundContact(0.0, 0.4, offset)
    times = np.linspace(0, 0.8, 33)
    solver, nodes, _ = simulate(lattice, law, (contact,), times, start=start)
    sag = G * (float(lattice.spacing.min()) / law.wave_speed_m_s) ** 2
    assert nodes[-1, :, 2] == pytest.approx(offset - sag, abs=1e-6)
    assert np.abs(nodes[-1] - nodes[-5]).max() < 1e-9
    assert solver.terms[0].deepest_m < 2e-3


@pytest.mark.parametrize("name", THIN)
def test_a_thin_body_that_slides_stops_where_coulomb_says(name: str) -> None:
    lattice, law, offset = THIN[name]
    start = rest_nodes(lattice) + np.array([0.0, 0.0, offset])
    contact = GroundContact(0.0, 0.4, offset)
    _, nodes, _ = simulate(
        lattice, law, (contact,), np.linspace(0, 0.6, 25), start=start, velocity=[0.0, 1.0, 0.0]
    )
    assert nodes[-1, :, 1] - start[:, 1] == pytest.approx(1 / (2 * 0.4 * G), rel=0.02)


def test_a_sheet_laid_over_a_ball_is_held_by_it() -> None:
    ball = Collider("ball", sdf.sphere(0.06), RigidPath.still((0.1, 0.1, 0.0)), 1.0)
    start = rest_nodes(SHEET) + np.array([0.0, 0.0, 0.0605])
    _, nodes, _ = simulate(SHEET, CLOTH, (ColliderContact(ball, 5e-4),), np.linspace(0, 0.5, 21), start=start)
    particles = SHEET.interpolation(SHEET.particle_coordinates) @ nodes[-1]
    assert ball.distance(particles, 0.0).min() > -1e-3
    assert particles[:, 2].max() > 0.058 and particles[:, 2].min() < 0.03


def test_material_that_starts_inside_is_not_thrown_out() -> None:
    plane, rest = ground(0.0, 0.5), rest_nodes(SHEET)
    start = rest + np.array([0.0, 0.0, -0.002])
    offsets = touching(SHEET, start, plane, 0.0, 5e-4)
    contact = GroundContact(0.0, 0.5, offsets)
    _, nodes, _ = simulate(SHEET, CLOTH, (contact,), np.linspace(0, 0.2, 11), start=start)
    assert nodes[..., 2].max() < -0.0019


def test_a_collider_too_fast_for_its_contact_is_refused_with_both_speeds() -> None:
    needle = Collider("needle", sdf.capsule(0.002, 0.05), line((0, 0, 0.2), (0, 0, -0.2), 0.1), 0.0)
    with pytest.raises(ContactFailed, match=r"needle moves at up to 6 m/s; 0\.\d+ m/s is the most"):
        simulate(BLOCK, LAW, (ColliderContact(needle),), np.linspace(0, 0.1, 5))


def test_a_body_that_came_too_deep_into_a_collider_is_not_trusted() -> None:
    plate = Collider("plate", sdf.box((0.3, 0.3, 0.004)), RigidPath.still((0.0, 0.0, -0.01)), 0.0)
    with pytest.raises(ContactFailed, match=r"a point came .* into plate"):
        simulate(BLOCK, LAW, (ColliderContact(plate),), np.linspace(0, 0.1, 11), velocity=[0.0, 0.0, -6.0])
