"""Air on a sheet: added mass and drag of a flat sheet that falls, in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from effect_twins import centroid, loose, moved

from physworld.effects.air_on_sheet import AirOnSheet
from physworld.effects.measurement_turn import MeasurementTurn

GRAVITY = (0.0, 0.0, -9.81)
TIMES = np.linspace(0.0, 0.2, 11)
STEP = 5e-3  # relative: symplectic Euler's error of first order in the step


def test_a_flat_sheet_falls_with_the_air_it_carries() -> None:
    twin = loose("sheet", GRAVITY)
    added = 0.5 * twin.density
    nodes = moved(twin.with_effect(AirOnSheet(added_kg_m2=added)), TIMES)
    fallen = centroid(twin, nodes)[:, 2] - centroid(twin, nodes)[0, 2]
    np.testing.assert_allclose(fallen[-1], -0.5 * 9.81 / 1.5 * TIMES[-1] ** 2, rtol=STEP)


def test_along_its_plane_a_sheet_falls_freely() -> None:
    twin = loose("sheet", (9.81, 0.0, 0.0))
    nodes = moved(twin.with_effect(AirOnSheet(1.0, 5.0, twin.density)), TIMES)
    gone = centroid(twin, nodes)[:, 0] - centroid(twin, nodes)[0, 0]
    np.testing.assert_allclose(gone[-1], 0.5 * 9.81 * TIMES[-1] ** 2, rtol=STEP)


def test_quadratic_drag_ends_a_fall_at_its_terminal_speed() -> None:
    twin = loose("sheet", GRAVITY)
    terminal = 0.4
    nodes = moved(twin.with_effect(AirOnSheet(0.0, twin.density * 9.81 / terminal**2)), TIMES)
    fallen = centroid(twin, nodes)[0, 2] - centroid(twin, nodes)[-1, 2]
    np.testing.assert_allclose(
        fallen, terminal**2 / 9.81 * np.log(np.cosh(9.81 * TIMES[-1] / terminal)), rtol=STEP
    )


def test_linear_drag_slows_as_an_exponential() -> None:
    twin = loose("sheet")
    rate = 4.0
    begin = np.tile([0.0, 0.0, 1.0], (len(twin.body.start), 1))
    nodes = moved(twin.with_effect(AirOnSheet(rate * twin.density)), TIMES, begin)
    gone = centroid(twin, nodes)[-1, 2] - centroid(twin, nodes)[0, 2]
    np.testing.assert_allclose(gone, (1.0 - np.exp(-rate * TIMES[-1])) / rate, rtol=STEP)


def test_a_turned_camera_turns_displacements() -> None:
    twin = loose("sheet")
    begin = twin.track_nodes(twin.carriers_start[None])
    tracks = np.concatenate([begin, begin + np.array([1.0, 0.0, 0.0])])
    seen = MeasurementTurn(z_rad=0.1).measured(TIMES[:2], tracks, twin)
    np.testing.assert_allclose(seen[0], begin[0])
    np.testing.assert_allclose(seen[1] - tracks[1], np.tile([0.0, 0.1, 0.0], (len(begin[0]), 1)), atol=1e-12)


def test_other_bodies_have_no_normal() -> None:
    with pytest.raises(Exception, match="normals of a sheet"):
        loose("rope").with_effect(AirOnSheet(1.0))
