"""Contact in the updated Lagrangian form against closed forms: Coulomb, Hooke, yield, a turntable, momentum."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
import trimesh
from bodies import GRAVITY, NeoHookean, SolidLaw, rest_nodes

from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.colliders import Collider
from physworld.engine.terms.colliders_path import RigidPath
from physworld.engine.terms.contact import ColliderContact, GroundContact
from physworld.engine.total.formulation import TotalLagrangian
from physworld.engine.updated.formulation import UpdatedLagrangian
from physworld.errors import ContactFailed
from physworld.materials.plastic import DruckerPrager, Plasticity, VonMises
from physworld.shapes import sdf

pytestmark = pytest.mark.slow

LAW = NeoHookean(2e5, 0.3, 20.0, 1000.0)
BLOCK = box_lattice(np.array([-0.05, -0.05, 0.0]), np.array([0.1, 0.1, 0.05]), (4, 4, 2))
MASS, G = 0.5, 9.81
GAUSS = 0.5 - 0.5 / np.sqrt(3.0)
"""Of a cell: how far the outermost particles lie behind a face."""

SINGLE = 2e-6
"""Velocities and impulses on the grid are single precision."""
COULOMB = 0.01
"""Friction forces are exact but for what the body still swings: measured 0.1 to 0.3 %."""
RIGID_FACES = 0.11
"""Contact acts at the outermost particles: 0.2 to 0.4 cells under each of two faces do not give, of eight."""
YIELDING = 0.08
"""The outermost half cells spread less than the rest: 6 % at six cells, 2 % at eight."""


def path(
    times: Iterable[float], places: Iterable[Iterable[float]], turns: np.ndarray | None = None
) -> RigidPath:
    knots, where = np.array(list(times)), np.array(list(places), dtype=float)
    return RigidPath(knots, where, np.repeat(np.eye(3)[None], len(knots), 0) if turns is None else turns)


def free(frames: int) -> HeldNodes:
    return HeldNodes(np.zeros(0, dtype=int), *np.zeros((2, frames, 0, 3)))


def simulate(
    lattice: Lattice, law: SolidLaw, terms: tuple, times: np.ndarray, *, gravity=GRAVITY, velocity=None,
    shift=(0.0, 0.0, 0.0), drag: float = 0.0, plasticity: Plasticity | None = None,
    at_once: bool | None = None,
) -> tuple[UpdatedLagrangian, np.ndarray, np.ndarray]:  # fmt: skip
    """Engine, particles (T, P, 3), and impulses of the contacts at the frames (T, terms, 3)."""
    rest = rest_nodes(lattice)
    v = np.zeros_like(rest) if velocity is None else np.broadcast_to(velocity, rest.shape).copy()
    problem = Problem(lattice, law, rest, np.asarray(gravity, dtype=float), drag_per_s=drag, terms=terms)
    engine = UpdatedLagrangian(problem, plasticity=plasticity)
    for contact in engine.terms.contacts:
        contact.at_once = contact.at_once if at_once is None else at_once
    impulses = [np.zeros((len(terms), 3))]

    def keep(frame: int, frames: int) -> None:
        impulses.append(np.array([contact.impulse_n_s for contact in engine.terms.contacts]))

    particles = engine.run_particles(rest + np.array(shift), v, free(len(times)), times, keep)
    return engine, particles, np.array(impulses)


def centre(engine: UpdatedLagrangian, particles: np.ndarray) -> np.ndarray:
    return np.einsum("p,tpi->ti", engine.mass, particles) / engine.mass.sum()


@pytest.mark.parametrize(("friction", "at_once"), [(0.3, None), (0.6, None), (0.3, True)])
def test_a_pushed_block_resists_with_coulombs_force(friction: float, at_once: bool | None) -> None:
    pusher = Collider(
        "pusher", sdf.box((0.05, 0.2, 0.06)), path([0, 1], [(-0.08, 0, 0.04), (0.07, 0, 0.04)]), 0.0
    )
    times = np.linspace(0, 1, 41)
    terms = (GroundContact(0.0, friction), ColliderContact(pusher))
    engine, particles, impulses = simulate(BLOCK, LAW, terms, times, at_once=at_once)
    force = (impulses[40] - impulses[20]) / 0.5
    assert force[0, 2] + force[1, 2] == pytest.approx(MASS * G, rel=COULOMB)
    assert force[1, 0] == pytest.approx(friction * force[0, 2], rel=COULOMB)
    assert force[1, 0] == pytest.approx(
        friction * MASS * G, rel=4 * COULOMB
    )  # the pusher's edge lifts a little
    assert np.ptp(centre(engine, particles)[20:, 2]) < 1e-4
    assert centre(engine, particles)[40, 0] - centre(engine, particles)[20, 0] == pytest.approx(
        0.075, rel=COULOMB
    )


@pytest.mark.parametrize(
    ("degrees", "friction", "at_once"), [(20.0, 0.5, None), (35.0, 0.9, None), (35.0, 0.9, True)]
)
def test_a_block_on_a_gentle_slope_sticks_and_does_not_creep(
    degrees: float, friction: float, at_once: bool | None
) -> None:
    slope = G * np.array([np.sin(np.radians(degrees)), 0.0, -np.cos(np.radians(degrees))])
    terms = (GroundContact(0.0, friction),)
    times = np.linspace(0, 2, 21)
    engine, particles, _ = simulate(BLOCK, LAW, terms, times, gravity=slope, at_once=at_once)
    x = centre(engine, particles)[:, 0]
    assert abs(x[20] - x[10]) < 1e-6  # free, it would slide 5 m


def test_a_block_on_a_steep_slope_slides_at_coulombs_acceleration() -> None:
    angle, friction, times = np.radians(40.0), 0.5, np.linspace(0, 0.5, 21)
    slope = G * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    terms = (GroundContact(0.0, friction),)
    engine, particles, _ = simulate(BLOCK, LAW, terms, times, gravity=slope)
    slid = 0.5 * G * (np.sin(angle) - friction * np.cos(angle)) * 0.5**2
    moved = centre(engine, particles)[-1, 0] - centre(engine, particles)[0, 0]
    assert moved == pytest.approx(slid, rel=COULOMB)


def test_the_grounds_friction_may_be_a_field_over_the_body() -> None:
    """The half of the block that is rough brings all of it to rest: mu is the mean of what carries the weight."""
    rest, times = rest_nodes(BLOCK), np.linspace(0, 0.4, 5)
    rough = np.where(BLOCK.particle_coordinates[:, 1] > 0, 1.5, 0.5)
    terms = (GroundContact(0.0, 0.4),)
    problem = Problem(BLOCK, LAW, rest, GRAVITY, friction_factor=rough, terms=terms)
    engine = UpdatedLagrangian(problem)
    start = np.tile([0.5, 0.0, 0.0], (len(rest), 1))
    moved = np.diff(centre(engine, engine.run_particles(rest, start, free(5), times))[[0, -1]], axis=0)[0]
    assert moved[0] == pytest.approx(0.25 / (2 * 0.4 * G), rel=0.05)
    particles = engine.run_particles(rest, start, free(5), times)[-1]
    ahead = particles[BLOCK.particle_coordinates[:, 1] < 0, 0].mean() - particles[:, 0].mean()
    assert ahead > 1e-4  # the smooth side runs ahead: the block turns


def test_contact_gives_no_energy_to_a_block_that_bounces() -> None:
    law, times = NeoHookean(2e5, 0.3, 0.0, 1000.0), np.linspace(0, 1.0, 101)
    terms = (GroundContact(-0.05, 0.3),)
    engine, particles, _ = simulate(BLOCK, law, terms, times)
    height = centre(engine, particles)[:, 2]
    floor = height[0] - 0.05
    peaks = [
        h for before, h, after in zip(height, height[1:], height[2:], strict=False) if before < h > after
    ]
    assert len(peaks) > 2 and peaks[0] < height[0] and peaks[1] < peaks[0]
    assert (height > floor - 0.01).all()


def test_a_plate_that_presses_drags_a_block_along_until_its_friction_gives_way() -> None:
    """On a frictionless ground; the plate's own pull is at most mu times what it presses with."""
    places = [(0, 0, 0.08), (0, 0, 0.068), (0, 0, 0.068), (0.05, 0, 0.068)]

    def travel(friction: float) -> float:
        plate = Collider("plate", sdf.box((0.6, 0.3, 0.04)), path([0.0, 0.2, 0.4, 0.9], places), friction)
        terms = (GroundContact(0.0, 0.0), ColliderContact(plate))
        engine, particles, _ = simulate(BLOCK, LAW, terms, np.linspace(0, 0.9, 37))
        return float(centre(engine, particles)[-1, 0] - centre(engine, particles)[0, 0])

    assert travel(0.5) == pytest.approx(0.05, abs=0.01)
    assert travel(0.0) == pytest.approx(0.0, abs=1e-3)


def test_momentum_of_the_body_is_what_contacts_and_gravity_gave() -> None:
    """The ball comes, pushes and leaves; adhesion would brake the body, and the push never turns into a pull."""
    ball = Collider("ball", sdf.sphere(0.03), path([0, 0.05, 0.1], [(-0.09, 0, 0.03), (-0.07, 0.005, 0.03), (-0.12, 0, 0.03)]), 0.3)  # fmt: skip  # noqa: E501
    times = np.linspace(0, 0.3, 61)
    terms = (GroundContact(-0.002, 0.4), ColliderContact(ball))
    rest = rest_nodes(BLOCK)
    engine = UpdatedLagrangian(Problem(BLOCK, LAW, rest, GRAVITY, terms=terms))
    run = engine.prepare(rest, np.zeros_like(rest), free(61))
    pushes = [np.zeros(3)]
    run.record(times, lambda *_: pushes.append(engine.terms.contacts[1].impulse_n_s))
    momentum = engine.mass @ run.particles.v.numpy().reshape(-1, 3)
    given = sum(contact.impulse_n_s for contact in engine.terms.contacts)
    weight = MASS * times[-1] * GRAVITY
    assert np.abs(momentum - given - weight).max() < 20 * SINGLE * MASS * G * times[-1]
    assert pushes[-1][0] > 0.1
    assert (np.diff(np.array(pushes)[:, 0]) >= -SINGLE).all()


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.5])
def test_a_block_under_a_plate_resists_with_its_modulus(offset: float) -> None:
    """Frictionless plates on a free column: F = E A strain, wherever the grid's nodes lie (``offset`` in cells)."""
    height, strain = 0.1, 0.01
    lattice = box_lattice(np.array([-0.025, -0.025, 0.0]), np.array([0.05, 0.05, height]), (4, 4, 8))
    up = offset * height / 8
    places = [(0, 0, height + 0.05 + up - strain * height * k) for k in (0, 1, 1)]
    plate = Collider("plate", sdf.box((0.2, 0.2, 0.1)), path([0, 0.1, 0.3], places), 0.0)
    terms = (GroundContact(up, 0.0), ColliderContact(plate))
    times = np.linspace(0, 0.3, 13)
    _, _, impulses = simulate(lattice, LAW, terms, times, gravity=np.zeros(3), shift=(0, 0, up), drag=20.0)
    force = (impulses[12] - impulses[11])[:, 2] / 0.025
    assert force[0] == pytest.approx(-force[1], rel=1e-3)
    assert force[0] == pytest.approx(LAW.youngs_modulus_pa * 0.05**2 * strain, rel=RIGID_FACES)


def test_a_plastic_block_yields_under_a_plate_at_its_stress_and_keeps_the_plates_shape() -> None:
    """Frictionless plates: the force is yield stress times the area that the volume leaves; an elastic one returns."""
    law, yields, size = NeoHookean(3e5, 0.3, 5.0, 1000.0), 6e3, 0.08
    lattice = box_lattice(np.array([-0.04, -0.04, 0.0]), np.full(3, size), (6, 6, 6))
    places = [(0, 0, 0.13), (0, 0, 0.10), (0, 0, 0.10), (0, 0, 0.16)]
    plate = Collider("plate", sdf.box((0.3, 0.3, 0.1)), path([0, 0.4, 0.45, 0.65], places), 0.0)
    terms, times = (GroundContact(0.0, 0.0), ColliderContact(plate)), np.linspace(0, 0.8, 33)
    ends = {}
    for name, flow in (("elastic", None), ("plastic", VonMises(yields))):
        _, particles, impulses = simulate(lattice, law, terms, times, plasticity=flow, drag=10.0)
        force = -np.diff(impulses[:, 1, 2]) / np.diff(times)
        top = np.isclose(lattice.particle_coordinates[:, 2], lattice.particle_coordinates[:, 2].max())
        assert np.ptp(particles[17, top, 2]) < 1e-4  # under the plate both are flat
        assert particles[17, top, 2].mean() == pytest.approx(0.05 - GAUSS * size / 6, abs=1e-4)
        ends[name] = particles[-1, top, 2]
        if flow is not None:
            heights = plate.path.poses(0.5 * (times[1:13] + times[:12]))[0][:, 2] - 0.05
            assert force[3:12] == pytest.approx(yields * size**3 / heights[3:], rel=YIELDING)
    springs_back = 0.05 * yields / law.youngs_modulus_pa
    assert np.ptp(ends["plastic"]) < 5e-4
    assert ends["plastic"].mean() - (0.05 - GAUSS * size / 6) == pytest.approx(springs_back, abs=springs_back)
    assert ends["elastic"].mean() > 0.074


def test_a_block_rides_on_a_turntable() -> None:
    """Friction holds it on its circle while mu g > omega^2 r, and turns it with the table."""
    spin, radius, times = 2.0, 0.1, np.linspace(0, 1.0, 21)
    knots = np.linspace(0, 1.0, 41)
    angle = 0.5 * spin * knots**2  # from rest: a constant angular acceleration
    turns = np.zeros((41, 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angle)
    turns[:, 1, 0], turns[:, 0, 1], turns[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
    table = Collider(
        "table", sdf.cylinder(0.3, 0.1), path(knots, np.tile([0, 0, -0.05], (41, 1)), turns), 0.8
    )
    lattice = box_lattice(np.array([radius - 0.03, -0.03, 0.0]), np.array([0.06, 0.06, 0.03]), (4, 4, 2))
    _, particles, _ = simulate(lattice, LAW, (ColliderContact(table),), times)
    turned = 0.5 * spin * times**2
    carried = np.stack([np.cos(turned), np.sin(turned)], axis=1) * radius
    assert np.abs(particles[..., :2].mean(axis=1) - carried).max() < 1e-3
    end = turns[-1] @ particles[0].T
    assert np.abs(particles[-1] - end.T).max() < 2e-3


def test_a_mesh_pushes_as_the_box_that_it_is() -> None:
    """Its samples end half a cell before the body's particles touch it."""
    whole = trimesh.creation.box((0.05, 0.06, 0.06))
    way, times = path([0, 0.5], [(-0.08, 0, 0.035), (0.0, 0, 0.035)]), np.linspace(0, 0.5, 11)
    ends = []
    for shape in (sdf.box((0.05, 0.06, 0.06)), sdf.mesh_shape(whole)):
        terms = (GroundContact(0.0, 0.3), ColliderContact(Collider("pusher", shape, way, 0.2)))
        _, particles, impulses = simulate(BLOCK, LAW, terms, times)
        ends.append((particles[-1], impulses[-1, 1, 0]))
    assert np.abs(ends[1][0] - ends[0][0]).max() < 1e-3  # edges of a mesh are rounded by half a sample
    assert ends[1][1] == pytest.approx(ends[0][1], rel=0.02)


def test_a_collider_thinner_than_a_cell_holds() -> None:
    shelf = Collider("shelf", sdf.box((0.3, 0.3, 0.008)), path([0], [(0, 0, -0.024)]), 0.5)
    engine, particles, _ = simulate(BLOCK, LAW, (ColliderContact(shelf),), np.linspace(0, 0.6, 13))
    lowest = particles[-1, :, 2].min()
    assert lowest == pytest.approx(-0.02 + GAUSS * 0.025, abs=2e-4)
    assert np.abs(particles[-1] - particles[-2]).max() < 1e-5
    assert engine.terms.contacts[0].deepest_m < 1e-3


def test_grains_are_swept_by_a_blade_and_none_pass_through() -> None:
    law = NeoHookean(2e5, 0.3, density_kg_m3=1500.0)
    lattice = box_lattice(np.array([-0.05, -0.05, 0.0]), np.array([0.1, 0.1, 0.06]), (5, 5, 3))
    blade = Collider(
        "blade", sdf.box((0.02, 0.4, 0.2)), path([0, 0.5], [(-0.07, 0, 0.1), (0.05, 0, 0.1)]), 0.4
    )
    terms = (GroundContact(0.0, 0.6), ColliderContact(blade))
    times = np.linspace(0, 0.5, 21)
    _, particles, impulses = simulate(lattice, law, terms, times, plasticity=DruckerPrager(0.6))
    assert particles[-1, :, 0].min() > 0.06
    assert particles[..., 2].min() > 0.0
    assert (
        impulses[-1, 1, 0] > 0.5 * 0.6 * 0.9 * G * 0.5 * 0.5
    )  # friction of the heap's 0.9 kg over half of the push


def pressed_ball(cells: int) -> tuple[float, float]:
    """Force of a ball 10 mm deep in a block ``cells`` high, updated and total Lagrangian [N]."""
    ball = Collider(
        "ball", sdf.sphere(0.04), path([0, 0.3, 0.6], [(0, 0, 0.1), (0, 0, 0.08), (0, 0, 0.08)]), 0.0
    )
    lattice = box_lattice(
        np.array([-0.05, -0.05, 0.0]), np.array([0.1, 0.1, 0.05]), (2 * cells, 2 * cells, cells)
    )
    terms = (GroundContact(0.0, 0.5), ColliderContact(ball))
    times = np.linspace(0, 0.6, 13)
    _, _, impulses = simulate(lattice, LAW, terms, times, drag=10.0)
    rest = rest_nodes(lattice)
    solver = TotalLagrangian(Problem(lattice, LAW, rest, GRAVITY, drag_per_s=10.0, terms=terms))
    pushes: list[float] = []
    solver.run(rest, 0 * rest, free(13), times, lambda *_: pushes.append(solver.terms[1].impulse_n_s[2]))
    return (impulses[10] - impulses[12])[1, 2] / 0.1, (pushes[9] - pushes[11]) / 0.1


def test_the_two_forms_close_in_on_one_force_of_a_ball_that_is_pressed_in() -> None:
    """The total form's penalty gives by a cell, the updated form's faces do not: they lie on two sides of the limit."""
    coarse, fine = pressed_ball(3), pressed_ball(5)
    assert coarse[1] < fine[1] < fine[0] < coarse[0]
    assert fine[0] - fine[1] < 0.7 * (coarse[0] - coarse[1])


def test_material_that_starts_inside_is_not_thrown_out() -> None:
    plate = Collider("plate", sdf.box((0.3, 0.3, 0.1)), path([0], [(0, 0, -0.048)]), 0.5)
    _, particles, _ = simulate(BLOCK, LAW, (ColliderContact(plate),), np.linspace(0, 0.3, 13))
    assert np.abs(particles[..., 2].mean(axis=1) - particles[0, :, 2].mean()).max() < 2e-4


def test_grains_that_a_paddle_crushes_on_the_ground_are_not_trusted() -> None:
    law = NeoHookean(2e5, 0.3, density_kg_m3=1500.0)
    lattice = box_lattice(np.array([-0.06, -0.06, 0.0]), np.array([0.12, 0.12, 0.06]), (6, 6, 3))
    paddle = Collider(
        "paddle", sdf.box((0.08, 0.04, 0.06)), path([0, 0.3], [(0, 0, 0.12), (0, 0, 0.032)]), 0.3
    )
    terms = (GroundContact(0.0, 0.5), ColliderContact(paddle))
    with pytest.raises(
        ContactFailed, match=r"times the body's wave modulus of 2\.69e\+05 Pa: material between"
    ):
        simulate(lattice, law, terms, np.linspace(0, 0.3, 13), plasticity=DruckerPrager(0.6))


def test_a_grip_that_carries_material_through_a_collider_is_not_trusted() -> None:
    shelf = Collider("shelf", sdf.box((0.3, 0.3, 0.02)), path([0], [(0, 0, -0.015)]), 0.0)
    rest, times = rest_nodes(BLOCK), np.linspace(0, 0.2, 21)
    way = -0.04 * times / 0.2
    paths = rest[None] + way[:, None, None] * np.array([0, 0, 1.0])
    held = HeldNodes(np.arange(len(rest)), paths, np.gradient(paths, times, axis=0))
    engine = UpdatedLagrangian(Problem(BLOCK, LAW, rest, GRAVITY, terms=(ColliderContact(shelf),)))
    with pytest.raises(ContactFailed, match=r"a particle came 0\.00\d+ m into shelf before t = "):
        engine.run_particles(rest, 0 * rest, held, times)
