"""Forces of effects on bodies that fly freely, against their closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_twins import SCENES, centroid, loose, moved, rubbed_fall, swirled
from scipy.spatial.transform import Rotation

from physworld.effects.registry import effect
from physworld.twin.twin import Twin

GRAVITY = (0.0, 0.0, -9.81)
FLIGHT = 2e-3  # share of the longest way
TIMES = np.linspace(0.0, 0.4, 9)


def flown(name: str, *effects: object, gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    twin = loose(name, gravity)
    for added in effects:
        twin = twin.with_effect(added)
    return centroid(twin, moved(twin, TIMES))


def centre_of_mass(twin: Twin) -> np.ndarray:
    return np.average(twin.particles_start, axis=0, weights=twin.particle_mass)


@pytest.mark.parametrize("name", SCENES)
def test_linear_drag_gives_the_terminal_velocity(name: str) -> None:
    rate = 8.0
    fall = flown(name, effect("air_drag_linear", rate_per_s=rate), gravity=GRAVITY)[:, 2]
    expected = -9.81 / rate * (TIMES - (1 - np.exp(-rate * TIMES)) / rate)
    np.testing.assert_allclose(fall, expected, atol=FLIGHT * np.abs(expected).max())


def test_drag_of_twin_and_effect_add_up() -> None:
    twin = loose("rope", GRAVITY, air_drag_per_s=3.0).with_effect(effect("air_drag_linear", rate_per_s=5.0))
    both = loose("rope", GRAVITY, air_drag_per_s=8.0)
    np.testing.assert_array_equal(moved(twin, TIMES), moved(both, TIMES))


@pytest.mark.parametrize("name", SCENES)
def test_quadratic_drag_gives_the_terminal_velocity(name: str) -> None:
    coefficient = 6.0
    fall = flown(name, effect("air_drag_quadratic", coefficient_per_m=coefficient), gravity=GRAVITY)[:, 2]
    expected = -np.log(np.cosh(np.sqrt(9.81 * coefficient) * TIMES)) / coefficient
    np.testing.assert_allclose(fall, expected, atol=FLIGHT * np.abs(expected).max())


@pytest.mark.parametrize("name", SCENES)
def test_dry_friction_slows_a_fall_by_the_same_at_every_speed(name: str) -> None:
    size = 4.0
    fall = flown(name, effect("dry_friction", size_m_s2=size), gravity=GRAVITY)[:, 2]
    law = rubbed_fall(TIMES, size)
    np.testing.assert_allclose(fall, law, atol=FLIGHT * np.abs(law).max())
    assert abs(law[-1] + 0.5 * (9.81 - size) * TIMES[-1] ** 2) < 0.02 * abs(law[-1])


@pytest.mark.parametrize("name", SCENES)
def test_a_swirl_carries_the_centre_of_mass_about_its_axis(name: str) -> None:
    spin, off = np.array([2.0, -1.0, 3.0]), np.array([0.2, -0.1, 0.05])
    middle = centre_of_mass(loose(name))
    given = {f"spin_{a}_per_s2": s for a, s in zip("xyz", spin, strict=True)}
    given |= {f"centre_{a}_m": c for a, c in zip("xyz", middle - off, strict=True)}
    expected = swirled(TIMES, spin, off)
    np.testing.assert_allclose(
        flown(name, effect("swirl", **given)), expected, atol=FLIGHT * np.abs(expected).max()
    )


@pytest.mark.parametrize("name", SCENES)
def test_wind_carries_a_body_to_its_own_velocity(name: str) -> None:
    rate, wind = 6.0, np.array([1.0, -0.5, 0.25])
    push = rate * wind
    blown = effect(
        "wind", push_x_m_s2=push[0], push_y_m_s2=push[1], push_z_m_s2=push[2], rate_per_s=rate
    )  # fmt: skip
    assert [blown.derived(loose(name, (0.0, 0.0, 0.0)))[f"wind_{a}_m_s"] for a in "xyz"] == [
        (w, "m/s") for w in wind
    ]
    expected = np.outer(TIMES - (1 - np.exp(-rate * TIMES)) / rate, wind)
    np.testing.assert_allclose(flown(name, blown), expected, atol=FLIGHT * np.abs(expected).max())


@pytest.mark.parametrize("name", SCENES)
def test_tilted_gravity_turns_the_fall(name: str) -> None:
    tilted = effect("gravity_tilt", tilt_x_rad=0.1, tilt_y_rad=-0.2, magnitude=0.05)
    pull = 1.05 * Rotation.from_rotvec([0.1, -0.2, 0.0]).apply(GRAVITY)
    expected = 0.5 * np.outer(TIMES**2, pull)
    np.testing.assert_allclose(
        flown(name, tilted, gravity=GRAVITY), expected, atol=2e-3 * expected[-1, 2] ** 2
    )


def test_gravity_that_is_not_vertical_tilts_about_axes_across_it() -> None:
    gravity = np.array([3.0, -4.0, -2.0])
    twin = replace(loose("rope"), gravity_m_s2=gravity).with_effect(effect("gravity_tilt", tilt_x_rad=0.3))
    fall = centroid(twin, moved(twin, TIMES))[-1]
    cosine = fall @ gravity / np.linalg.norm(fall) / np.linalg.norm(gravity)
    assert np.arccos(cosine) == pytest.approx(0.3, rel=1e-3)


@pytest.mark.parametrize("name", SCENES)
def test_buoyancy_and_added_mass_slow_the_fall(name: str) -> None:
    fall = flown(name, effect("buoyancy", density_ratio=0.4, added_mass_ratio=0.5), gravity=GRAVITY)[:, 2]
    expected = -0.5 * 9.81 * (1 - 0.4) / (1 + 0.5) * TIMES**2
    np.testing.assert_allclose(fall, expected, atol=FLIGHT * np.abs(expected).max())


@pytest.mark.parametrize("name", SCENES)
def test_a_tethered_body_swings_at_the_frequency_of_its_spring(name: str) -> None:
    twin = loose(name)
    mass, middle = float(twin.particle_mass.sum()), centre_of_mass(twin)
    stiffness = mass * 15.0**2
    offset = np.array([0.01, -0.02, 0.015])
    anchor, whole = middle + offset, {f"attach_{a}_m": c for a, c in zip("xyz", middle, strict=True)}
    held = {f"anchor_{a}_m": c for a, c in zip("xyz", anchor, strict=True)}
    tied = twin.with_effect(effect("tether", stiffness_n_m=stiffness, radius_m=10.0, **whole, **held))
    way = centroid(tied, moved(tied, TIMES))
    expected = np.outer(1 - np.cos(15.0 * TIMES), offset)
    np.testing.assert_allclose(way, expected, atol=5e-3 * np.abs(expected).max())


def test_a_tether_with_a_rest_length_pushes_where_it_is_short() -> None:
    twin = loose("solid")
    middle = centre_of_mass(twin)
    place = {f"attach_{a}_m": c for a, c in zip("xyz", middle, strict=True)}
    place |= {f"anchor_{a}_m": c for a, c in zip("xyz", middle - [0.0, 0.0, 0.1], strict=True)}
    stiffness = float(twin.particle_mass.sum()) * 100.0
    tied = effect("tether", stiffness_n_m=stiffness, radius_m=10.0, rest_length_m=0.15, **place)
    early = flown("solid", tied)[1]
    expected = 0.05 * (1 - np.cos(10.0 * TIMES[1]))
    np.testing.assert_allclose(early, [0.0, 0.0, expected], atol=1e-2 * expected)


def test_a_tether_without_places_holds_the_free_end_where_it_started() -> None:
    twin = loose("rope", GRAVITY)
    tied = twin.with_effect(effect("tether", stiffness_n_m=1e3 * float(twin.particle_mass.sum())))
    anchor, attach = tied.effects[0].places(tied)
    np.testing.assert_array_equal(anchor, attach)
    ends = np.abs(twin.particles_start - attach).max(axis=1)
    assert ends.min() == 0.0
    nodes = moved(tied, TIMES)
    fallen = (tied.particles_at(nodes)[-1] - twin.particles_start)[:, 2]
    assert abs(fallen[np.argmin(ends)]) < 0.1 * abs(fallen[np.argmax(ends)])


@pytest.mark.parametrize("name", SCENES)
def test_a_force_on_the_whole_body_moves_it_by_newtons_law(name: str) -> None:
    twin = loose(name)
    mass = float(twin.particle_mass.sum())
    force = mass * np.array([0.5, 1.0, -2.0])
    pushed = effect(
        "region_force", force_x_n=force[0], force_y_n=force[1], force_z_n=force[2], radius_m=10.0
    )  # fmt: skip
    expected = 0.5 * np.outer(TIMES**2, force / mass)
    np.testing.assert_allclose(flown(name, pushed), expected, atol=FLIGHT * np.abs(expected).max())


def test_a_force_on_an_end_turns_the_body_and_moves_its_centre_by_newtons_law() -> None:
    twin = loose("solid")
    mass = float(twin.particle_mass.sum())
    pushed = twin.with_effect(effect("region_force", force_z_n=mass, x_m=0.16, y_m=0.02, z_m=0.02))
    nodes = moved(pushed, TIMES)
    np.testing.assert_allclose(centroid(pushed, nodes)[-1], [0, 0, 0.5 * TIMES[-1] ** 2], atol=1e-3)
    ends = pushed.particles_at(nodes)[-1] - twin.particles_start
    far = np.argmax(twin.particles_start[:, 0])
    near = np.argmin(twin.particles_start[:, 0])
    assert ends[far, 2] > ends[near, 2] + 0.05
