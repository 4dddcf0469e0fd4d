"""How much of a shard's work is done, by its stages."""

from __future__ import annotations

import pytest

from physworld_schemas.model import TrainingConfig
from physworld_services.trainer.training import stages_of
from physworld_workers.pace import Pace


def test_stages_count_by_their_weights_and_the_share_never_falls() -> None:
    pace = Pace()
    pace.plan({"reading": 1.0, "training": 6.0, "exporting": 3.0})
    shares = []
    for stage, steps in (("reading", (0, 1)), ("training", (0, 3, 6, 2)), ("exporting", (0, 5, 6))):
        pace.begin(stage)
        shares += [pace.reach(done, 6) for done in steps]
    assert shares == pytest.approx([0.0, 1 / 60, 0.1, 0.4, 0.7, 0.7, 0.7, 0.95, 1.0])


def test_a_stage_with_a_budget_is_nearly_done_where_such_stages_end() -> None:
    pace = Pace()
    pace.plan({"calibrating": 70.0, "measuring": 30.0})
    pace.begin("calibrating", usual=50.0)
    shares = [pace.reach(done, 400) for done in (25, 50, 225, 400)]
    assert shares == pytest.approx([0.7 * 0.45, 0.7 * 0.9, 0.7 * 0.95, 0.7])
    pace.begin("measuring")
    assert pace.reach(1, 2) == pytest.approx(0.85)


def test_a_budget_below_the_usual_is_spent() -> None:
    pace = Pace()
    pace.plan({"calibrating": 1.0})
    pace.begin("calibrating", usual=50.0)
    assert pace.reach(6, 12) == pytest.approx(0.5)


def test_without_a_plan_what_is_counted_is_the_whole() -> None:
    pace = Pace()
    assert pace.reach(3, 12) == 0.25
    assert pace.reach(4, 0) == 0.25  # a total that is not known says nothing


def test_a_stage_that_was_not_planned_is_refused() -> None:
    with pytest.raises(KeyError, match="polishing"):
        Pace().begin("polishing")


def test_most_of_a_short_training_is_not_its_steps() -> None:
    stages = stages_of(TrainingConfig(steps=20))
    assert stages["training"] < 0.5 * sum(stages.values())
