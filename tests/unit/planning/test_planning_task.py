"""A plan with a real model and its twin: the same controllers reach both, and the goal error falls in the twin."""

from __future__ import annotations

import numpy as np
import pytest
from published_tiny import tiny_model

from physworld.planning.goals import GoalPoints
from physworld.planning.mppi import MppiConfig, search
from physworld.planning.task import PlanningTask

pytestmark = pytest.mark.slow

HORIZON = 20


@pytest.fixture(scope="module")
def task() -> PlanningTask:
    scene, twin, model = tiny_model()
    return PlanningTask.of(model, twin, scene)


def test_controllers_begin_as_the_recording_and_move_with_their_grip(task: PlanningTask) -> None:
    moved = np.linspace(0.0, 0.03, HORIZON)[:, None, None] * np.array([0.0, 1.0, 0.0])
    path = task.controllers(moved)
    past = task.model.start_controllers
    assert np.array_equal(path[: len(past)], past)
    assert path[-1] == pytest.approx(past[-1] + [0.0, 0.03, 0.0])
    assert task.controllers(moved[None])[0] == pytest.approx(path)


def test_the_twin_starts_a_plan_where_the_model_does(task: PlanningTask) -> None:
    still = np.zeros((HORIZON, 1, 3))
    executed, predicted = task.execute(still), task.predict(still[None])[0]
    assert executed.shape == predicted.shape
    ticks = task.dt_s * np.arange(len(task.model.start_history))
    recorded = task.twin.track_nodes(task.twin.simulate_nodes(*task.scene.control_track(), ticks))
    assert np.linalg.norm(recorded[-1] - task.start_points, axis=1).max() < 5e-4
    apart = np.linalg.norm(executed - predicted, axis=2).mean()
    a_tick_late = np.linalg.norm(executed[1:] - predicted[:-1], axis=2).mean()
    # a start that is a tick off turns the two round; what the tiny model itself errs depends on the processor's algebra
    assert apart < 0.75 * a_tick_late


def test_a_plan_starts_with_the_velocities_that_the_recording_ends_with(task: PlanningTask) -> None:
    past = task.model.start_controllers
    expected = [(past[-1][grip] - past[-2][grip]).mean(axis=0) / task.dt_s for grip in task.grips]
    assert task.limits.started_m_s == pytest.approx(np.array(expected))
    assert task.with_limits(speed_m_s=0.2).limits.started_m_s == pytest.approx(np.array(expected))


def test_a_planned_motion_brings_the_twin_nearer_to_the_goal(task: PlanningTask) -> None:
    end = task.start_points[-1] + np.array([0.0, 0.02, 0.01])
    goal = GoalPoints(np.array([len(task.start_points) - 1]), end[None])
    # enough of a search that its seed and the processor's algebra count little
    config = MppiConfig(horizon=HORIZON, samples=96, iterations=12)
    found = search(task.predict, goal, task.limits, task.dt_s, config, np.random.default_rng(0))
    ending = slice(-config.settling, None)
    executed = goal.distance(task.execute(found.displacements)[ending]).mean()
    motionless = goal.distance(task.execute(np.zeros_like(found.displacements))[ending]).mean()
    assert executed < 0.4 * motionless


def test_limits_that_leave_out_the_start_are_refused(task: PlanningTask) -> None:
    with pytest.raises(ValueError, match="leaves out the start"):
        task.with_limits(box_min_m=np.array([0.01, 0.0, 0.0]))
    assert task.with_limits(speed_m_s=0.2).limits.speed_m_s == 0.2
