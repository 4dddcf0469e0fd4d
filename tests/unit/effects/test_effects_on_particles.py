"""Effects in the updated Lagrangian form: nothing at zero, the total form's answer or a closed form where they act."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp
from effect_twins import SCENES, TWINS, moved, rubbed_fall, simulated, swirled
from same_numbers import assert_same

from physworld.effects.base import Effect
from physworld.effects.registry import EFFECTS, effect
from physworld.errors import SceneUnsupported
from physworld.materials.plastic import VonMises
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

TIMES = np.linspace(0.0, 0.4, 9)
SETTLED = np.linspace(0.0, 1.0, 3)
GRAVITY = (0.0, 0.0, -9.81)
FLIGHT = 2e-3
"""Share of the longest way."""
DROOP = 0.08
"""Two cells across the bar: a droop differs by 5 %, and with three cells by 2 %."""
ROOT = 0.3
"""What acts at the grip's face, or against the bar's mean: it meets the root's strains, which two cells blur."""
AT_REST = {
    "rest_shape": DROOP, "mass_field": DROOP, "gravity_tilt": DROOP, "buoyancy": DROOP, "wind": DROOP,
    "anisotropy": DROOP, "tether": DROOP, "region_force": DROOP, "time_varying_stiffness": DROOP,
    "stiffness_field": ROOT, "clamp_offset": ROOT,
}  # fmt: skip


def updated(twin: Twin) -> Twin:
    return replace(twin, formulation="updated_lagrangian")


def free(gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Twin:
    """The bar, held by nobody, above no ground."""
    twin = replace(TWINS["solid"], held_nodes=(), controller_groups=(), controllers_start=np.empty((0, 3)))
    return updated(replace(twin, ground_height_m=None, gravity_m_s2=np.array(gravity)))


def way(twin: Twin, times: np.ndarray = TIMES, velocity: np.ndarray | None = None) -> np.ndarray:
    """Centre of mass against the first frame's, (T, 3)."""
    start = None if velocity is None else np.tile(velocity, (len(twin.body.start), 1))
    mass = twin.particle_mass
    centre = np.einsum("p,tpi->ti", mass, moved(twin, times, start)) / mass.sum()
    return centre - centre[0]


def strong(name: str, twin: Twin) -> Effect:
    gates = {s.name: min(5 * s.probe, s.high) for s in EFFECTS[name].strengths(twin) if s.gate}
    return effect(name, **gates)


def launched(twin: Twin, monkeypatch: pytest.MonkeyPatch) -> tuple[np.ndarray, int]:
    calls, launch = [], wp.launch
    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch", lambda *a, **k: (calls.append(1), launch(*a, **k))[1])
        return simulated(twin, SCENES["solid"]()), len(calls)


def test_all_effects_at_zero_change_no_bit_and_launch_no_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = updated(TWINS["solid"])
    twin = plain
    for name, kind in EFFECTS.items():
        if kind.refuses(twin) is None:
            twin = twin.with_effect(effect(name))
    assert len(twin.effects) > len(EFFECTS) - 5
    (with_zeros, count), (without, plain_count) = launched(twin, monkeypatch), launched(plain, monkeypatch)
    assert_same(with_zeros, without)
    assert count == plain_count


@pytest.mark.parametrize("name", [n for n, k in EFFECTS.items() if k.refuses(TWINS["solid"]) is None])
def test_every_effect_acts_on_a_bar_of_particles(name: str) -> None:
    twin, scene = updated(TWINS["solid"]), SCENES["solid"]()
    added = strong(name, twin)
    changed = twin.with_effect(added)
    tracks = [t.observe(simulated(t, scene), scene.times) for t in (twin, changed)]
    assert 1e-7 < np.abs(tracks[1] - tracks[0]).max() < 0.1


@cache
def at_rest(form: str, name: str | None) -> np.ndarray:
    """Tracked points of the damped bar in its grip, without ground, when it hangs still."""
    twin = replace(TWINS["solid"], ground_height_m=None, formulation=form)
    twin = twin.with_parameters(youngs_modulus_pa=2e5, air_drag_per_s=15.0)
    twin = twin if name is None else twin.with_effect(strong(name, twin))
    return twin.observe(moved(twin, SETTLED), SETTLED)[-1]


@pytest.mark.parametrize("name", AT_REST)
def test_both_forms_give_an_effect_the_same_droop(name: str) -> None:
    total, particles = (
        at_rest(f, name) - at_rest(f, None) for f in ("total_lagrangian", "updated_lagrangian")
    )
    assert np.abs(particles - total).max() < AT_REST[name] * np.abs(total).max()


def test_quadratic_drag_gives_the_terminal_velocity() -> None:
    fall = way(free(GRAVITY).with_effect(effect("air_drag_quadratic", coefficient_per_m=6.0)))[:, 2]
    expected = -np.log(np.cosh(np.sqrt(9.81 * 6.0) * TIMES)) / 6.0
    np.testing.assert_allclose(fall, expected, atol=FLIGHT * np.abs(expected).max())


def test_dry_friction_slows_a_fall_by_the_same_at_every_speed() -> None:
    fall = way(free(GRAVITY).with_effect(effect("dry_friction", size_m_s2=4.0)))[:, 2]
    expected = rubbed_fall(TIMES, 4.0)
    np.testing.assert_allclose(fall, expected, atol=FLIGHT * np.abs(expected).max())


def test_a_swirl_carries_the_centre_of_mass_about_its_axis() -> None:
    spin, off = np.array([2.0, -1.0, 3.0]), np.array([0.2, -0.1, 0.05])
    twin = free()
    middle = np.average(twin.particles_start, axis=0, weights=twin.particle_mass)
    given = {f"spin_{a}_per_s2": s for a, s in zip("xyz", spin, strict=True)}
    given |= {f"centre_{a}_m": c for a, c in zip("xyz", middle - off, strict=True)}
    expected = swirled(TIMES, spin, off)
    np.testing.assert_allclose(
        way(twin.with_effect(effect("swirl", **given))), expected, atol=FLIGHT * np.abs(expected).max()
    )


def test_wind_and_linear_drag_carry_a_body_to_the_winds_velocity() -> None:
    wind, rate = np.array([1.0, -0.5, 0.25]), 6.0
    push = dict(zip(("push_x_m_s2", "push_y_m_s2", "push_z_m_s2"), 4.0 * wind, strict=True))
    blown = free().with_effect(effect("wind", rate_per_s=4.0, **push))
    blown = blown.with_effect(effect("air_drag_linear", rate_per_s=rate - 4.0))
    expected = np.outer(TIMES - (1 - np.exp(-rate * TIMES)) / rate, 4.0 / rate * wind)
    np.testing.assert_allclose(way(blown), expected, atol=FLIGHT * np.abs(expected).max())


def test_buoyancy_and_added_mass_slow_the_fall() -> None:
    fall = way(free(GRAVITY).with_effect(effect("buoyancy", density_ratio=0.4, added_mass_ratio=0.5)))[:, 2]
    expected = -0.5 * 9.81 * 0.6 / 1.5 * TIMES**2
    np.testing.assert_allclose(fall, expected, atol=FLIGHT * np.abs(expected).max())


def test_a_tethered_body_swings_at_the_frequency_of_its_spring() -> None:
    twin = free()
    mass, offset = float(twin.particle_mass.sum()), np.array([0.01, -0.02, 0.015])
    middle = np.average(twin.particles_start, axis=0, weights=twin.particle_mass)
    places = {f"attach_{a}_m": c for a, c in zip("xyz", middle, strict=True)}
    places |= {f"anchor_{a}_m": c for a, c in zip("xyz", middle + offset, strict=True)}
    tied = twin.with_effect(effect("tether", stiffness_n_m=mass * 225.0, radius_m=10.0, **places))
    expected = np.outer(1 - np.cos(15.0 * TIMES), offset)
    np.testing.assert_allclose(way(tied), expected, atol=5e-3 * np.abs(expected).max())


def test_a_force_on_an_end_moves_the_centre_by_newtons_law_and_turns_the_bar() -> None:
    twin = free()
    force = float(twin.particle_mass.sum()) * np.array([0.5, 1.0, -2.0])
    named = dict(zip(("force_x_n", "force_y_n", "force_z_n"), force, strict=True))
    pushed = twin.with_effect(effect("region_force", x_m=0.16, y_m=0.02, z_m=0.02, **named))
    expected = 0.5 * np.outer(TIMES**2, [0.5, 1.0, -2.0])
    np.testing.assert_allclose(way(pushed), expected, atol=FLIGHT * np.abs(expected).max())
    ends = moved(pushed, TIMES)[-1] - twin.particles_start
    x = twin.particles_start[:, 0]
    assert ends[np.argmin(x), 2] > ends[np.argmax(x), 2] + 0.05


def test_a_grip_that_gives_sinks_by_the_weight_times_its_compliance() -> None:
    twin = replace(updated(TWINS["solid"]), ground_height_m=None).with_parameters(air_drag_per_s=15.0)
    weight = float(twin.particle_mass.sum()) * 9.81
    held = np.isin(twin.lattice.cell_nodes, np.concatenate(twin.held_nodes)).all(axis=1)
    gripped = np.repeat(held, 8)
    sinks = 1e-4
    soft = twin.with_effect(effect("grip_slip", compliance_m_n=sinks / weight, damping_ratio=1.0))
    path = np.average(moved(soft, SETTLED)[:, gripped], axis=1, weights=twin.particle_mass[gripped])
    assert path[-1, 2] - path[0, 2] == pytest.approx(-sinks, rel=0.02)


@pytest.mark.parametrize("change", [-0.2, 0.3])
def test_other_ground_friction_gives_another_coulomb_distance(change: float) -> None:
    height = float(TWINS["solid"].body.rest[:, 2].min() + 0.5 * TWINS["solid"].lattice.spacing[2])
    twin = replace(free(GRAVITY), ground_height_m=height, ground_friction=0.4)
    slid = way(
        twin.with_effect(effect("ground_friction", change=change)),
        np.linspace(0, 0.6, 4),
        np.array([0.5, 0, 0]),
    )
    assert slid[-1, 0] == pytest.approx(0.25 / (2 * (0.4 + change) * 9.81), rel=0.02)


@pytest.mark.parametrize(("share", "leaves"), [(0.85, False), (1.15, True)])
def test_adhesion_holds_until_the_pull_is_its_traction_times_the_area(share: float, leaves: bool) -> None:
    height = float(TWINS["solid"].body.rest[:, 2].min() + 0.5 * TWINS["solid"].lattice.spacing[2])
    traction, area = 2000.0, 0.16 * 0.04
    pull = share * traction * area / float(TWINS["solid"].particle_mass.sum())
    twin = replace(free((0.0, 0.0, pull)), ground_height_m=height)
    stuck = twin.with_effect(effect("adhesion", traction_pa=traction, reach_m=0.002))
    assert (way(stuck, np.linspace(0, 0.2, 3))[-1, 2] > 0.05) == leaves


def test_adhesion_that_reaches_the_second_layer_is_refused() -> None:
    sticky = updated(TWINS["solid"]).with_effect(effect("adhesion", traction_pa=100.0, reach_m=0.03))
    with pytest.raises(SceneUnsupported, match=r"adhesion reaches 0\.03 m"):
        simulated(sticky, SCENES["solid"]())


def test_a_lag_is_the_record_later() -> None:
    twin, scene = updated(TWINS["solid"]), SCENES["solid"]()
    lagging = simulated(twin.with_effect(effect("actuation_lag", lag_s=0.02)), scene)
    times, points = scene.control_track()
    later = twin.simulate_nodes(times + 0.02, points, scene.times)
    shown = np.abs(lagging - simulated(twin, scene)).max()
    assert np.abs(lagging - later).max() < 0.03 * shown  # the run stops at other times


@pytest.mark.parametrize("name", ["viscoelastic_maxwell", "anisotropy", "strain_stiffening", "plasticity"])
def test_a_stress_of_the_whole_deformation_is_refused_beside_a_flow_law(name: str) -> None:
    twin = replace(updated(TWINS["solid"]), plasticity=VonMises(1e4))
    with pytest.raises(SceneUnsupported, match=f"{name} reads the whole deformation"):
        simulated(twin.with_effect(strong(name, twin)), SCENES["solid"]())


def test_declared_loads_hang_from_the_particles_and_weigh_what_they_weigh() -> None:
    """A load on a few nodes of the tip: both forms sag by the same."""
    twin = replace(TWINS["solid"], ground_height_m=None).with_parameters(
        youngs_modulus_pa=2e5, air_drag_per_s=15.0
    )
    tip = twin.body.rest[:, 0] > 0.15
    load = np.where(tip, 0.02 / tip.sum(), 0.0)
    sags = []
    for form in ("total_lagrangian", "updated_lagrangian"):
        known = replace(twin, formulation=form)
        loaded = replace(known, body=replace(known.body, added_mass=load))
        ends = [t.observe(moved(t, SETTLED), SETTLED)[-1, -1, 2] for t in (known, loaded)]
        sags.append(ends[1] - ends[0])
    assert sags[0] < -2e-4
    assert sags[1] == pytest.approx(sags[0], rel=DROOP)
