"""Bodies that are driven from inside: steps of the rest shape are seen, simulated and found."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from made_scene import made_scene, recorded_by

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.calibrate.rod_parameters import steps_seen
from physworld.evaluate.table import held_out_table
from physworld.scene import Body, Scene
from physworld.twin.build import build_twin
from physworld.twin.rods import driven_at
from physworld.twin.twin import Twin

LENGTH, FRAMES = 0.1, 120
STEP = (0.3, 0.05, 1.5, -0.4, 0.01, 0.0)  # begins, rises [s], curvatures [1/m], stretch; it does not vent


@cache
def arm() -> Scene:
    """An arm that hangs from four markers on its base, with three around its tip."""
    turns = 2 * np.pi * np.arange(4) / 4
    base = np.stack([0.05 * np.cos(turns), 0.05 * np.sin(turns), np.zeros(4)], axis=1)
    tip = np.array([[0.02, 0.0, -LENGTH], [-0.01, 0.017, -LENGTH], [-0.01, -0.017, -LENGTH]])
    scene = made_scene(tip, "arm", base, FRAMES, body=Body(length_m=LENGTH, density_kg_m3=1000.0))
    return replace(scene, times=0.01 * np.arange(FRAMES), train=(0, 90), test=(90, FRAMES))


def driven(scene: Scene) -> Twin:
    """Its twin, with a step."""
    twin = build_twin(scene)
    stiff = 0.03 * twin.density
    return replace(twin, drive=np.array([STEP])).with_parameters(bending_n_m2=stiff, relaxation_s=0.004)


def test_a_step_rises_linearly_and_stays() -> None:
    found = driven_at(np.array([STEP]), np.array([0.0, 0.3, 0.325, 0.35, 9.0]))
    np.testing.assert_allclose(found[:, 0], [0.0, 0.0, 0.75, 1.5, 1.5])
    np.testing.assert_allclose(found[-1], STEP[2:5])
    assert not driven_at(None, np.arange(3.0)).any()


def test_a_constant_curvature_bends_an_arm_by_half_its_square() -> None:
    scene = arm()
    twin = replace(driven(scene), gravity_m_s2=np.zeros(3))
    tracks = twin.track_nodes(twin.simulate_nodes(*scene.control_track(), scene.times))
    moved = np.linalg.norm((tracks[-1] - tracks[0]).mean(axis=0)[:2])
    free = LENGTH * (1.0 - 1.0 / len(twin.lattice.cells))  # the first edge is held
    assert moved == pytest.approx(
        0.5 * np.hypot(*STEP[2:4]) * free * (free + LENGTH / len(twin.lattice.cells)), rel=0.05
    )


def test_only_what_moves_by_itself_is_driven() -> None:
    scene = arm()
    recorded = recorded_by(driven(scene), scene, 2e-5)
    seen = steps_seen(recorded)
    assert seen is not None and seen[:, 0] == pytest.approx([STEP[0]], abs=0.05)
    assert steps_seen(scene) is None  # nothing moves
    carried = replace(recorded, controllers=recorded.controllers + 1e-3 * recorded.times[:, None, None])
    assert steps_seen(carried) is None  # its base does
    swings = 0.01 * np.sin(2 * np.pi * scene.times)[:, None, None]
    assert steps_seen(replace(scene, points=scene.points + swings)) is None  # it never rested


def test_a_base_of_one_marker_holds_an_edge() -> None:
    scene = arm()
    twin = build_twin(replace(scene, controllers=scene.controllers[:, :1] * [0.0, 0.0, 1.0]))
    assert twin.held_nodes[0].tolist() == [0, 1]


@pytest.mark.slow
def test_a_step_is_found_and_the_body_stays_where_it_was_driven() -> None:
    scene = arm()
    recorded = recorded_by(driven(scene), scene, 2e-5)
    fitted = calibrate(recorded, CalibrationConfig(max_simulations=200))
    found = fitted.parameters
    assert found["drive_0_s"].value == pytest.approx(STEP[0], abs=0.02)
    track = held_out_table(recorded, {"twin": fitted.tracks})["track_m"]
    assert track["twin"] < 0.05 * track["static"]
