"""Effects of ground, grips, fields, rest shape and time, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from effect_twins import SCENES, TWINS, centroid, loose, moved
from scipy.optimize import brentq
from scipy.sparse import csr_matrix

from physworld.effects.registry import effect
from physworld.effects.time_varying_stiffness import GrowingStiffness
from physworld.engine.problem import Problem, nodal_mass
from physworld.engine.terms.contact import GroundContact
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import CFLViolation
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

FIRST_ROOT = 1.8751  # of cos x cosh x = -1, the clamped-free beam


def block(friction: float, speed: float = 0.0, gravity: float = -9.81) -> Twin:
    """A bar lying on the ground at its own lower face, nobody holding it."""
    twin = loose("solid", (0.0, 0.0, gravity), youngs_modulus_pa=2e5, viscosity_pa_s=10.0)
    velocity = np.tile([speed, 0.0, 0.0], (len(twin.body.start), 1))
    body = replace(twin.body, start_velocity=velocity)
    return replace(twin, body=body, ground_height_m=0.0, ground_friction=friction)


def cantilever(bending_n_m2: float = 0.1, gravity: float = 0.0) -> tuple[Twin, float]:
    """The rope as a rod held at its first end, and its free length [m]."""
    twin = TWINS["rope"].with_parameters(bending_n_m2=bending_n_m2, stretching_n=30.0)
    twin = replace(twin, gravity_m_s2=np.array([0.0, 0.0, gravity]), ground_height_m=None)
    held = twin.held_nodes[0]
    cells = np.isin(twin.lattice.cell_nodes, held).all(axis=1)
    face = float((twin.lattice.origin + (twin.lattice.cells[cells].max() + 1) * twin.lattice.spacing)[0])
    return twin, 0.3 - face


def ringing(twin: Twin, duration: float = 0.6, shape: float = 2.0) -> float:
    """Angular frequency [rad/s] of a tip that was given a small upward velocity, from its zero crossings."""
    velocity = np.zeros_like(twin.body.start)
    velocity[:, 2] = 0.02 * np.clip(twin.body.start[:, 0] / 0.3, 0.0, None) ** shape
    times = np.linspace(0.0, duration, 1201)
    nodes = moved(twin, times, velocity)
    tip = nodes[:, np.argmax(twin.body.start[:, 0]), 2]
    tip = tip - tip[0]
    up = np.flatnonzero((tip[:-1] < 0) & (tip[1:] >= 0))
    exact = times[up] - tip[up] * (times[1] - times[0]) / (tip[up + 1] - tip[up])
    return float(2 * np.pi * (len(exact) - 1) / (exact[-1] - exact[0]))


def test_changed_friction_stops_a_sliding_block_at_the_coulomb_distance() -> None:
    twin, speed = block(0.2, speed=0.6), 0.6
    rough = twin.with_effect(effect("ground_friction", change=0.25))
    times = np.linspace(0.0, 0.5, 26)
    way = centroid(twin, moved(rough, times))[-1, 0]
    assert way == pytest.approx(speed**2 / (2 * 0.45 * 9.81), rel=0.08)
    assert centroid(twin, moved(twin, times))[-1, 0] > 1.5 * way
    smooth = twin.with_effect(effect("ground_friction", change=-0.5))
    assert centroid(twin, moved(smooth, times))[-1, 0] == pytest.approx(speed * times[-1], rel=1e-3)


def test_a_lower_ground_lets_a_block_settle_lower() -> None:
    twin = block(0.5)
    lower = twin.with_effect(effect("ground_friction", height_m=-0.004))
    times = np.linspace(0.0, 0.6, 7)
    difference = centroid(twin, moved(lower, times) - moved(twin, times) + twin.body.start)[-1, 2]
    assert difference == pytest.approx(-0.004, abs=4e-4)


def test_adhesion_holds_a_block_until_its_weight_is_greater() -> None:
    twin = block(0.5, gravity=9.81)  # gravity pulls it up, off the ground
    area = 0.16 * 0.04
    weight = float(twin.particle_mass.sum()) * 9.81
    times = np.linspace(0.0, 0.3, 4)
    stuck = twin.with_effect(effect("adhesion", traction_pa=3.0 * weight / area))
    freed = twin.with_effect(effect("adhesion", traction_pa=0.8 * weight / area))
    assert abs(centroid(twin, moved(stuck, times))[-1, 2]) < 0.002
    assert centroid(twin, moved(freed, times))[-1, 2] > 0.05


def test_added_mass_leaves_the_weight_of_a_hanging_load() -> None:
    twin, _ = cantilever(gravity=-9.81)
    load = np.zeros(len(twin.body.start))
    load[-3:] = 0.02
    twin, scene = replace(twin, body=replace(twin.body, added_mass=load)), SCENES["rope"]()
    weights = []
    for ratio in (0.0, 0.8):
        known = twin.with_effect(effect("buoyancy", density_ratio=0.3, added_mass_ratio=ratio))
        problem = known.integration(*scene.control_track(), scene.times).problem
        weights.append(problem.nodal_mass() * problem.gravity_m_s2[2])
    np.testing.assert_allclose(*weights)


def test_added_mass_lowers_the_frequency_of_a_cantilever() -> None:
    twin, length = cantilever()
    plain = ringing(twin)
    law = twin.law
    expected = FIRST_ROOT**2 * np.sqrt(law.bending_n_m2 / law.density_kg_m / length**4)
    assert plain == pytest.approx(expected, rel=0.02)
    heavier = ringing(twin.with_effect(effect("buoyancy", added_mass_ratio=0.8)))
    assert heavier == pytest.approx(plain / np.sqrt(1.8), rel=2e-3)


def test_a_weight_at_the_tip_lowers_the_frequency_as_beam_theory_says() -> None:
    twin, length = cantilever()
    weighed = twin.with_effect(effect("mass_field", bump=3.0, bump_x=1.0, bump_width=0.03))
    problem = weighed.effects[0].problem(Problem(twin.lattice, twin.law, twin.body.rest, np.zeros(3)), twin)
    ratio = problem.nodal_mass().sum() / nodal_mass(twin.lattice, twin.law, None).sum() - 1.0
    tip = ratio * 0.3 / length

    def root(x: float) -> float:
        """Clamped beam with a tip mass: 1 + cos cosh = tip x (sin cosh - cos sinh)."""
        return 1 + np.cos(x) * np.cosh(x) - tip * x * (np.sin(x) * np.cosh(x) - np.cos(x) * np.sinh(x))

    expected = (brentq(root, 0.5, FIRST_ROOT) / FIRST_ROOT) ** 2
    assert ratio > 0.2
    assert ringing(weighed) / ringing(twin) == pytest.approx(expected, rel=0.03)


def test_a_rod_that_is_softer_at_one_end_hangs_as_its_integral_says() -> None:
    """u(L) = int rho g (L - s) / EA(s) ds for a rod that hangs along x."""
    twin, length = cantilever(4e-3)
    twin = twin.with_parameters(air_drag_per_s=25.0, density_kg_m=1.0)
    twin = replace(twin, gravity_m_s2=np.array([1.0, 0.0, 0.0]))
    graded = twin.with_effect(effect("stiffness_field", slope_x=0.8))
    times = np.array([0.0, 1.0, 2.0])
    tip = twin.lattice.interpolation(np.array([[0.3]]))
    first = (tip @ moved(twin, times)[-1])[0, 0] - 0.3
    found = (tip @ moved(graded, times)[-1])[0, 0] - 0.3
    s = np.linspace(0.3 - length, 0.3, 4001)
    load = (0.3 - s) / 30.0
    even, uneven = np.trapezoid(load, s), np.trapezoid(load * np.exp(-0.8 * (s / 0.15 - 1)), s)
    assert first == pytest.approx(even, rel=0.03)  # the clamp of a rod reaches a part of a cell too far
    assert found / first == pytest.approx(uneven / even, rel=0.01)


@pytest.mark.parametrize("name", SCENES)
def test_fields_have_slopes_without_mean_and_bumps_where_they_are_told(name: str) -> None:
    twin = TWINS[name]
    problem = Problem(twin.lattice, twin.law, twin.body.rest, np.zeros(3))
    sloped = effect("stiffness_field", slope_x=0.5).problem(problem, twin).stiffness_factor
    assert np.average(np.log(sloped), weights=twin.lattice.particle_measures) == pytest.approx(0.0, abs=1e-12)
    filled = twin.lattice.particle_measures > 0
    assert np.ptp(np.log(sloped[filled])) == pytest.approx(1.0, rel=1e-9)
    bumped = effect("mass_field", bump=1.0, bump_x=1.0, bump_width=0.2).problem(problem, twin).density_factor
    x = twin.lattice.particle_coordinates[:, 0]
    assert np.argmax(bumped) in np.flatnonzero(np.isclose(x, x[filled].max()))
    assert bumped.max() <= np.e and bumped.min() < 1.01
    both = effect("mass_field", slope_x=0.1).problem(replace(problem, density_factor=bumped), twin)
    assert np.abs(both.density_factor / bumped - 1).max() > 0.05


@pytest.mark.parametrize("name", SCENES)
def test_a_body_whose_rest_shape_is_longer_grows_to_it(name: str) -> None:
    twin = loose(name, air_drag_per_s=25.0)
    grown = twin.with_effect(effect("rest_shape", strain_x=0.05))
    last = moved(grown, np.linspace(0.0, 1.0, 3))[-1]
    extent = np.ptp(last, axis=0)[0] / np.ptp(twin.body.start, axis=0)[0]
    assert extent == pytest.approx(1.05, rel=2e-3)
    assert np.ptp(moved(twin, np.linspace(0.0, 1.0, 3))[-1], axis=0)[0] == pytest.approx(
        np.ptp(twin.body.start, axis=0)[0], rel=1e-6
    )


def test_a_longer_rest_shape_keeps_the_mass() -> None:
    twin = TWINS["solid"]
    problem = Problem(twin.lattice, twin.law, twin.body.rest, np.zeros(3))
    grown = effect("rest_shape", strain_x=0.1, strain_y=-0.05, strain_z=0.02).problem(problem, twin)
    np.testing.assert_allclose(grown.nodal_mass(), problem.nodal_mass(), rtol=1e-12)


@pytest.mark.parametrize("name", ["solid", "sheet", "rope"])
@pytest.mark.parametrize("strain", [0.1, -0.1])
def test_another_rest_shape_touches_the_ground_with_the_same_material(name: str, strain: float) -> None:
    twin, scene = TWINS[name], SCENES[name]()
    places = []
    for one in (twin, twin.with_effect(effect("rest_shape", strain_x=strain))):
        problem = one.integration(*scene.control_track(), scene.times).problem
        (ground,) = [term for term in problem.terms if isinstance(term, GroundContact)]
        rows, columns, weights = (array.numpy() for array in ground.bind(problem)._surface[:3])
        points = csr_matrix((weights, columns, rows), shape=(len(rows) - 1, len(twin.body.start)))
        places.append(points @ twin.body.start)
    np.testing.assert_allclose(*places, atol=1e-12)


def test_a_bent_rest_shape_bends_a_free_rod_to_its_circle() -> None:
    twin = loose("rope", air_drag_per_s=60.0, bending_n_m2=4e-3, stretching_n=30.0)
    bent = twin.with_effect(effect("rest_shape", curvature_1_per_m=3.0))
    nodes = moved(bent, np.linspace(0.0, 3.0, 3))[-1]
    rows = [twin.lattice.interpolation(twin.lattice.particle_coordinates, (order,)) for order in (1, 2)]
    t, c = rows[0] @ nodes, rows[1] @ nodes
    curvature = np.linalg.norm(np.cross(t, c), axis=1) / np.linalg.norm(t, axis=1) ** 3
    middle = slice(len(curvature) // 4, -len(curvature) // 4)
    np.testing.assert_allclose(curvature[middle], 3.0, rtol=0.01)


def test_a_bent_rest_shape_bends_a_free_strip_and_a_free_bar() -> None:
    sheet = loose("sheet", air_drag_per_s=40.0, bending_n_m=1e-3)
    strip = sheet.with_effect(effect("rest_shape", curvature_1_per_m=2.0))
    nodes = moved(strip, np.linspace(0.0, 1.5, 3))[-1]
    rows = [
        sheet.lattice.interpolation(np.array([[0.1, 0.1]]), o) @ nodes
        for o in ((1, 0), (0, 1), (2, 0), (0, 2))
    ]
    normal = np.cross(rows[0], rows[1])[0] / np.linalg.norm(np.cross(rows[0], rows[1]))
    assert normal @ rows[2][0] == pytest.approx(2.0, rel=0.05)
    assert abs(normal @ rows[3][0]) < 0.1
    bar = loose("solid", air_drag_per_s=40.0, poissons_ratio=0.0)
    bowed = bar.with_effect(effect("rest_shape", curvature_2_per_m=1.5))
    end = moved(bowed, np.linspace(0.0, 1.0, 3))[-1]
    along = bar.lattice.interpolation(np.array([[x, 0.02, 0.02] for x in (0.02, 0.08, 0.14)])) @ end
    sag = along[1, 2] - 0.5 * (along[0, 2] + along[2, 2])
    assert abs(sag) == pytest.approx(0.5 * 1.5 * 0.06**2, rel=0.1)


@pytest.mark.parametrize("share", [-0.5, 0.5, 1.0, 1.5])
def test_a_longer_clamp_shortens_the_cantilever(share: float) -> None:
    twin, length = cantilever()
    cell = float(twin.lattice.spacing[0])
    other = ringing(twin.with_effect(effect("clamp_offset", reach_m=share * cell)))
    expected = (length / (length - share * cell)) ** 2
    assert other / ringing(twin) - 1 == pytest.approx(expected - 1, rel=0.2)


@pytest.mark.parametrize("name", ["solid", "sheet"])
def test_a_clamp_that_reaches_a_cell_farther_holds_that_cell(name: str) -> None:
    twin = TWINS[name]
    reach = float(twin.lattice.spacing[0])
    longer = effect("clamp_offset", reach_m=1.01 * reach).grips(twin)
    added = np.setdiff1d(longer.held_nodes[0], twin.held_nodes[0])
    assert len(added)
    before = twin.lattice.node_coordinates[twin.held_nodes[0], 0].max()
    assert twin.lattice.node_coordinates[added, 0].max() == pytest.approx(before + reach)


@pytest.mark.parametrize("name", ["solid", "sheet", "rope"])
def test_a_clamp_that_ends_within_the_first_cell_has_a_face_too(name: str) -> None:
    twin = TWINS[name]
    nodes = twin.lattice.node_coordinates[:, 0]
    planes = np.unique(np.round(nodes, 9))[:2]  # of the three that a cell has
    thin = np.flatnonzero(np.isin(np.round(nodes, 9), planes))
    loosely = replace(twin, held_nodes=(thin,), controller_groups=twin.controller_groups[:1])
    assert not np.isin(twin.lattice.cell_nodes, thin).all(axis=1).any()
    reach = float(twin.lattice.spacing[0])
    longer = effect("clamp_offset", reach_m=1.01 * reach).grips(loosely)
    assert len(longer.held_nodes[0]) > len(thin)
    times = np.linspace(0.0, 0.1, 3)
    softer = loosely.with_effect(effect("clamp_offset", reach_m=-0.5 * reach))
    assert not np.allclose(moved(softer, times)[-1], moved(loosely, times)[-1], atol=1e-7)
    alone = replace(twin, held_nodes=(thin[:1],), controller_groups=twin.controller_groups[:1])
    if name != "rope":
        assert "no face" in (effect("clamp_offset").refuses(alone) or "")


def test_a_turned_clamp_turns_what_it_holds() -> None:
    twin = TWINS["solid"]
    turned = twin.with_effect(effect("clamp_offset", angle_y_rad=0.1))
    times = np.linspace(0.0, 0.2, 5)
    nodes, plain = moved(turned, times), moved(twin, times)
    held = twin.held_nodes[0]
    middle = twin.body.start[held].mean(axis=0)
    flat = twin.body.start[held] - middle
    expected = middle + flat @ np.array(
        [[np.cos(0.1), 0, -np.sin(0.1)], [0, 1, 0], [np.sin(0.1), 0, np.cos(0.1)]]
    )
    np.testing.assert_allclose(nodes[-1, held], expected, atol=1e-9)
    np.testing.assert_allclose(plain[-1, held], twin.body.start[held], atol=1e-9)


@pytest.mark.parametrize("name", SCENES)
def test_a_grip_that_gives_sinks_under_the_weight_by_its_compliance(name: str) -> None:
    twin = replace(TWINS[name], ground_height_m=None, gravity_m_s2=np.array([0.0, 0.0, -9.81]))
    twin = twin.with_parameters(air_drag_per_s=20.0)
    weight = 9.81 * float(twin.particle_mass.sum())
    soft = twin.with_effect(effect("grip_slip", compliance_m_n=0.002 / weight, damping_ratio=1.0))
    nodes = moved(soft, np.linspace(0.0, 2.0, 3))
    held = twin.held_nodes[0]
    mass = nodal_mass(twin.lattice, twin.law, None)[held]
    sunk = (mass @ (nodes[-1, held] - twin.body.start[held])) / mass.sum()
    assert sunk[2] == pytest.approx(-0.002, rel=0.05)


def test_every_grip_has_the_compliance_whatever_it_holds() -> None:
    first, last = np.arange(3), np.arange(len(TWINS["rope"].body.start))[-8:]
    twin = replace(
        TWINS["rope"],
        held_nodes=(first, last),
        controller_groups=(np.array([0]), np.array([1])),
        controllers_start=TWINS["rope"].body.start[[1, -4]],
        grip_regions=(None, None),
        ground_height_m=None,
    )
    soft = twin.with_effect(effect("grip_slip", compliance_m_n=2e-3, damping_ratio=0.5))
    times = np.linspace(0.0, 1.0, 3)
    still = np.repeat(twin.controllers_start[None], 2, axis=0)
    run = soft.integration(times[[0, -1]], still, times)
    bound = run.problem.terms[-1].bind(run.problem)
    stiffness, friction = (bound.inputs[k].numpy() for k in (1, 2))
    mass = run.problem.nodal_mass()
    for nodes, own in ((first, slice(0, 3)), (last, slice(3, 11))):
        held = mass[nodes].sum()
        assert stiffness[own].sum() == pytest.approx(1.0 / 2e-3)
        assert friction[own].sum() == pytest.approx(np.sqrt(held / 2e-3))
        np.testing.assert_allclose(stiffness[own] / stiffness[own].sum(), mass[nodes] / held)
    assert bound.frequency_rad_s == pytest.approx(1.0 / np.sqrt(2e-3 * mass[first].sum()))


def test_a_grip_that_gives_follows_a_slow_gripper() -> None:
    twin = replace(TWINS["rope"], gravity_m_s2=np.zeros(3), ground_height_m=None)
    soft = twin.with_effect(effect("grip_slip", compliance_m_n=2e-3))
    times = np.linspace(0.0, 2.0, 21)
    controls = twin.controllers_start + 0.02 * np.sin(0.5 * np.pi * times / 2.0)[:, None, None] ** 2
    nodes = soft.simulate_nodes(times, controls, times)
    held = twin.held_nodes[0]
    np.testing.assert_allclose(nodes[-1, held] - twin.body.start[held], 0.02, atol=5e-4)


def test_stiffness_grows_as_the_exponential_of_time() -> None:
    twin = TWINS["rope"]
    problem = Problem(twin.lattice, twin.law, twin.body.rest, np.zeros(3))
    changed = effect("time_varying_stiffness", log_rate_per_s=-0.4).problem(problem, twin)
    bound = changed.terms[0].bind(problem)
    times = np.array([0.0, 0.5, 1.0])
    bound.begin(times)
    force = wp.array(np.arange(6.0), dtype=wp.float64)
    clock = wp.array([0.5, 20.0, 0.05], dtype=wp.float64)
    bound.launch(force, force, clock, wp.array([1, 4, 10], dtype=wp.int32), force)
    np.testing.assert_allclose(force.numpy(), np.arange(6.0) * np.exp(-0.4 * 0.7), rtol=1e-12)
    with pytest.raises(CFLViolation, match="grows"):  # nobody said how long the run is
        GrowingStiffness(0.5).bind(problem).begin(np.array([0.0, 2.0]))


@pytest.mark.parametrize("name", TWINS)
def test_a_stiffness_that_grows_far_runs_at_the_time_step_of_its_stiffest_moment(name: str) -> None:
    twin = replace(TWINS[name], ground_height_m=None)
    grown = twin.with_effect(effect("time_varying_stiffness", log_rate_per_s=10.0))
    times = np.linspace(0.0, 0.3, 7)
    still = np.repeat(twin.controllers_start[None], 2, axis=0)
    plain, run = (known.integration(times[[0, -1]], still, times) for known in (twin, grown))
    ratio = TotalLagrangian(plain.problem).time_step_s / TotalLagrangian(run.problem).time_step_s
    assert ratio == pytest.approx(np.sqrt(1.0 + np.exp(3.0) - 2.0), rel=0.05)
    nodes = grown.simulate_nodes(times[[0, -1]], still, times)
    size = np.ptp(moved(twin, times), axis=0).max()
    assert np.ptp(nodes, axis=0).max() < 2 * size
    first = grown.simulate_nodes(times[[0, -1]], still, times[:3])  # fewer frames of the same motion
    np.testing.assert_allclose(first, nodes[:3], atol=1e-3 * size)


def test_a_stiffness_that_grows_far_runs_on_particles() -> None:
    twin = replace(TWINS["solid"], ground_height_m=None, formulation="updated_lagrangian")
    grown = twin.with_effect(effect("time_varying_stiffness", log_rate_per_s=25.0))
    times = np.linspace(0.0, 0.12, 7)
    droop = [np.abs(moved(known, times) - known.particles_start).max() for known in (twin, grown)]
    assert 1e-3 < droop[1] < droop[0]


def test_a_cantilever_that_softens_rings_slower_in_the_end() -> None:
    """The phase is the integral of exp(a t / 2): a drift of 1/T ln."""
    twin, _ = cantilever()
    softer = ringing(twin.with_effect(effect("time_varying_stiffness", log_rate_per_s=-1.0)))
    mean = (1 - np.exp(-0.5 * 0.6)) / (0.5 * 0.6)
    assert softer / ringing(twin) == pytest.approx(mean, rel=0.03)
