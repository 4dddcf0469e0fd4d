"""Rigid paths: through their knots, with the velocities that their positions have."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from physworld.engine.terms.colliders import Collider
from physworld.engine.terms.colliders_path import RigidPath
from physworld.errors import SceneUnsupported
from physworld.shapes import sdf

RNG = np.random.default_rng(3)
KNOTS = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
TURNS = Rotation.from_rotvec(np.cumsum(RNG.normal(scale=0.4, size=(5, 3)), axis=0)).as_matrix()
PATH = RigidPath(KNOTS, RNG.normal(scale=0.1, size=(5, 3)), TURNS)


def test_a_path_goes_through_its_knots_and_stands_still_outside() -> None:
    places, turns, velocity, spin = PATH.poses(np.concatenate([[-1.0], KNOTS, [9.0]]))
    assert places == pytest.approx(PATH.positions[[0, 0, 1, 2, 3, 4, 4]])
    assert turns == pytest.approx(PATH.rotations[[0, 0, 1, 2, 3, 4, 4]], abs=1e-12)
    assert not velocity[[0, -1]].any() and not spin[[0, -1]].any()


@pytest.mark.parametrize("time", [0.03, 0.0999, 0.1001, 0.27, 0.42])
def test_velocities_are_the_rates_of_the_poses(time: float) -> None:
    step = 1e-6
    places, turns, velocity, spin = PATH.poses(np.array([time - step, time, time + step]))
    assert velocity[1] == pytest.approx((places[2] - places[0]) / (2 * step), abs=1e-6)
    rate = (turns[2] - turns[0]) / (2 * step) @ turns[1].T
    assert spin[1] == pytest.approx([rate[2, 1], rate[0, 2], rate[1, 0]], abs=1e-6)


def test_velocities_do_not_jump_at_a_knot() -> None:
    _, _, velocity, spin = PATH.poses(np.array([0.25 - 1e-9, 0.25 + 1e-9]))
    assert velocity[0] == pytest.approx(velocity[1], abs=1e-6)
    assert spin[0] == pytest.approx(spin[1], rel=1e-5)


def test_between_two_poses_the_rotation_is_slerp() -> None:
    path = RigidPath(KNOTS[:2], np.zeros((2, 3)), TURNS[:2])
    times = np.linspace(0.01, 0.09, 5)
    expected = Slerp(KNOTS[:2], Rotation.from_matrix(TURNS[:2]))(times).as_matrix()
    assert path.poses(times)[1] == pytest.approx(expected, abs=1e-12)


def test_no_point_is_faster_than_the_bound() -> None:
    times, reach = np.linspace(0.0, 0.4999, 400), 0.2
    _, _, velocity, spin = PATH.poses(times)
    fastest = np.linalg.norm(velocity, axis=1) + reach * np.linalg.norm(spin, axis=1)
    assert 0.3 * PATH.fastest_m_s(reach) < fastest.max() <= PATH.fastest_m_s(reach)


def test_a_collider_answers_in_the_world() -> None:
    collider = Collider("brick", sdf.box((0.2, 0.1, 0.1)), PATH, 0.5)
    place, turn, _, _ = PATH.poses(np.array([0.2]))
    points = place + np.array([[0.25, 0.0, 0.0], [0.0, 0.0, -0.04]]) @ turn[0].T
    assert collider.distance(points, 0.2) == pytest.approx([0.15, -0.01])
    assert collider.normal(points, 0.2) == pytest.approx(
        np.array([[1, 0, 0], [0, 0, -1]]) @ turn[0].T, abs=1e-12
    )
    later = PATH.poses(np.array([0.2 + 1e-7]))
    carried = (points - place) @ turn[0] @ later[1][0].T + later[0]
    assert collider.velocity(points, 0.2) == pytest.approx((carried - points) / 1e-7, abs=1e-4)


@pytest.mark.parametrize("fault", ["nan", "order", "none"])
def test_a_path_that_is_no_path_is_refused(fault: str) -> None:
    times, places = KNOTS.copy(), PATH.positions.copy()
    if fault == "nan":
        places[2, 1] = np.nan
    elif fault == "order":
        times[3] = times[2]
    else:
        times, places = times[:0], places[:0]
    with pytest.raises(SceneUnsupported, match="every number must be finite and the times increase"):
        RigidPath(times, places, TURNS)
