"""How much of a shard's work is done, by its stages, and how long it will take yet."""

from __future__ import annotations

import pytest

from physworld_schemas.model import TrainingConfig
from physworld_services.trainer.training import stages_of
from physworld_workers.pace import Pace


class Clock:
    """Seconds that pass when told to."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_stages_count_by_their_weights_and_the_share_never_falls() -> None:
    pace = Pace(Clock())
    pace.plan({"reading": 1.0, "training": 6.0, "exporting": 3.0})
    shares = []
    for stage, steps in (("reading", (0, 1)), ("training", (0, 3, 6, 2)), ("exporting", (0, 5, 6))):
        pace.begin(stage)
        shares += [pace.reach(done, 6)[0] for done in steps]
    assert shares == pytest.approx([0.0, 1 / 60, 0.1, 0.4, 0.7, 0.7, 0.7, 0.95, 1.0])


def test_the_time_left_is_told_at_the_pace_of_this_attempt() -> None:
    clock = Clock()
    pace = Pace(clock)
    pace.plan({"reading": 20.0, "training": 60.0, "exporting": 20.0})
    pace.begin("reading")
    assert pace.reach(0, 1) == (0.0, None)
    pace.begin("training")
    share, left = pace.reach(50, 100)  # the checkpoint of an attempt before this one
    assert (share, left) == (pytest.approx(0.5), None)
    clock.now_s += 10.0
    share, left = pace.reach(75, 100)
    assert share == pytest.approx(0.65)
    assert left == pytest.approx(10.0 * 0.35 / 0.15, abs=0.1)


def test_without_a_plan_what_is_counted_is_the_whole() -> None:
    pace = Pace(Clock())
    assert pace.reach(3, 12)[0] == 0.25
    assert pace.reach(4, 0)[0] == 0.25  # a total that is not known says nothing


def test_a_stage_that_was_not_planned_is_refused() -> None:
    with pytest.raises(KeyError, match="polishing"):
        Pace().begin("polishing")


def test_most_of_a_short_training_is_not_its_steps() -> None:
    stages = stages_of(TrainingConfig(steps=20))
    assert stages["training"] < 0.5 * sum(stages.values())
