"""The numerics of a twin on its scene: what is measured, and that it would show a bad scheme."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.evaluate.numerics import dominant_frequency, free_swing, measure_numerics, refined
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

LOW, HIGH = np.array([0.0, -0.015, -0.015]), np.array([0.15, 0.015, 0.015])
FRAMES = 45
BUDGET = 150
SINGLE = 2e-4  # the updated form keeps velocities in single precision


def swinging_bar() -> Scene:
    """A bar clamped over its first 3 cm that falls from level."""
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    return made_scene(
        [[x, 0.0, 0.015] for x in (0.05, 0.1, 0.15)],
        "beam",
        grip,
        FRAMES,
        body=box_body(LOW, HIGH, density_kg_m3=300.0),
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.03, 0.015, 0.015])),),
        initial_state=UNDEFORMED_AT_REST,
    )


def test_numerics_of_a_swinging_bar_are_small_and_stated() -> None:
    scene = swinging_bar()
    twin = build_twin(scene, BUDGET).with_parameters(
        youngs_modulus_pa=5e4, air_drag_per_s=0.5, viscosity_pa_s=2.0
    )
    told: list[tuple[int, int]] = []
    found = measure_numerics(
        scene, twin, particle_budget=BUDGET, progress=lambda done, most, text: told.append((done, most))
    )
    assert (
        abs(found.equivalent_drag_per_s) < 1e-3
    )  # friction is off in the free swing: only the scheme's is left
    assert found.damping_ratio == pytest.approx(
        found.equivalent_drag_per_s / (4 * np.pi * found.dominant_mode_hz), rel=1e-9
    )
    beam = 3.516 / (2 * np.pi) * np.sqrt(5e4 * 0.03**2 / 12 / 300.0) / 0.12**2
    assert found.dominant_mode_hz == pytest.approx(beam, rel=0.1)
    assert abs(found.lost_share) < 1e-3
    assert 0 < found.half_step_m < 1e-4
    assert found.half_step_m < found.finer_cells_m < 5e-3
    assert found.finer_particles > 1.3 * found.particles
    assert told == [(0, 4), (1, 4), (2, 4), (4, 4)]


def test_the_updated_form_reports_its_own_damping() -> None:
    scene = swinging_bar()
    found = {}
    for transfer in ("apic", "asflip"):
        twin = build_twin(scene, BUDGET, formulation="updated_lagrangian", transfer=transfer)
        found[transfer] = measure_numerics(
            scene, twin.with_parameters(youngs_modulus_pa=5e4), particle_budget=BUDGET
        )
    apic, asflip = found["apic"], found["asflip"]
    assert apic.equivalent_drag_per_s > 0.1 and apic.equivalent_drag_per_s > 2 * asflip.equivalent_drag_per_s
    assert apic.damping_ratio is not None and apic.damping_ratio > 2e-3
    assert apic.lost_share > 10 * SINGLE
    assert 0 < apic.half_step_m < apic.finer_cells_m and apic.finer_particles > 1.3 * apic.particles


def test_a_finer_twin_keeps_parameters_and_material_points() -> None:
    scene = swinging_bar()
    twin = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=5e4, air_drag_per_s=0.5)
    moved = replace(twin, body=replace(twin.body, points=twin.body.points + 1e-3))
    finer = refined(scene, moved, BUDGET, 2.0)
    assert finer.parameters == twin.parameters
    np.testing.assert_array_equal(finer.body.points, moved.body.points)
    assert finer.lattice.spacing.max() < 0.7 * twin.lattice.spacing.max()


def test_a_body_that_hangs_in_balance_is_kicked_and_swings() -> None:
    scene = swinging_bar()
    weightless = replace(scene, gravity_m_s2=np.zeros(3))
    twin = build_twin(weightless, BUDGET).with_parameters(youngs_modulus_pa=5e4)
    swing = free_swing(weightless, twin)
    assert swing.mode_hz is not None and swing.ledger.kinetic.max() > 0
    assert abs(swing.equivalent_drag_per_s) < 1e-3


def test_the_dominant_frequency_is_that_of_the_strongest_cosine() -> None:
    times = np.linspace(0.0, 3.0, 91)
    tracks = np.zeros((91, 2, 3))
    tracks[:, 0, 2] = np.cos(2 * np.pi * 2.3 * times) + 0.3 * np.sin(2 * np.pi * 7.0 * times)
    tracks[:, 1, 2] = 0.5 * np.cos(2 * np.pi * 2.3 * times)
    assert dominant_frequency(times, tracks) == pytest.approx(2.3, rel=5e-3)
    assert dominant_frequency(times, np.ones((91, 2, 3))) is None
    assert dominant_frequency(times, times[:, None, None] * np.ones((91, 2, 3))) is None
    for few in (1, 2, 3):  # too short for any frequency
        assert dominant_frequency(times[:few], tracks[:few]) is None


def test_cells_that_end_at_a_small_grip_are_refined_all_the_same() -> None:
    """A grip in the middle of an end leaves few sizes of cells to choose from, and the next one may be far away."""
    scene = swinging_bar()
    low, high = np.array([-0.1, -0.05, -0.045]), np.array([0.1, 0.05, 0.045])
    grip = Grip((0, 1, 2, 3), np.array([-0.1, -0.017, -0.015]), np.array([-0.067, 0.017, 0.015]))
    scene = replace(scene, body=box_body(low, high, density_kg_m3=540.0), grips=(grip,))
    twin = build_twin(scene, 1000)
    particles = twin.lattice.fill.size
    assert build_twin(scene, 1000, refinement=1.4).lattice.fill.size / particles < 0.6 * 1.4**3
    for factor in (1.4, 1.0 / 1.4):
        found = refined(scene, twin, 1000, factor).lattice.fill.size
        assert found / particles == pytest.approx(factor**3, rel=0.42)
