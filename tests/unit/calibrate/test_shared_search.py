"""A calibration whose simulations are shared: the same numbers, counts, history and journal as in one process."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from made_scene import recorded_by
from test_journal import bar as bar
from test_torsion import BENDING_N_M2, TORSION, two_hands

from physworld.calibrate import CalibrationConfig, FitResult, Journal, calibrate
from physworld.errors import Cancelled
from physworld.estimation.simulations import Drive, Job, Workers, in_turn
from physworld.scene import Scene
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

CONFIG = CalibrationConfig(particle_budget=60, max_simulations=140)


class Together:
    """A runner of this process that notes how many simulations came at once."""

    def __init__(self, processes: int = 1) -> None:
        self.processes = processes
        self.widths: list[int] = []

    def __call__(
        self, jobs: Sequence[Job], drive: Drive, poll: Callable[[], None]
    ) -> Iterator[np.ndarray | None]:
        self.widths.append(len(jobs))
        poll()
        return in_turn(jobs, drive, poll)


def same(one: FitResult, other: FitResult) -> None:
    assert one.parameters == other.parameters
    np.testing.assert_equal(one.rejected, other.rejected)  # also where both are not a number
    assert (one.simulations, one.loss_history) == (other.simulations, other.loss_history)
    np.testing.assert_array_equal(one.tracks, other.tracks)


def found(scene: Scene, runner: Any, most: int = 140) -> tuple[FitResult, list[str]]:
    saved: list[str] = []
    config = CalibrationConfig(particle_budget=60, max_simulations=most)
    return calibrate(scene, config, journal=Journal("k", None, saved.append), runner=runner), saved


def test_processes_find_what_one_process_finds(bar: Scene) -> None:
    alone, steps = found(bar, in_turn)
    with Workers(2) as workers:
        shared, shared_steps = found(bar, workers)
    same(shared, alone)
    assert shared_steps == steps


@pytest.mark.slow
def test_descents_side_by_side_count_as_one_after_the_other() -> None:
    scene = two_hands()
    truth = build_twin(scene).with_parameters(bending_n_m2=BENDING_N_M2, torsion_ratio=TORSION)
    scene = recorded_by(truth, scene, 2e-4)
    alone, steps = found(scene, in_turn, 100)
    together = Together()
    shared, shared_steps = found(scene, together, 100)
    same(shared, alone)
    assert shared_steps == steps
    assert together.widths[0] == 12 and 3 in together.widths and 6 in together.widths


def test_what_runs_ahead_in_a_free_process_changes_nothing(bar: Scene) -> None:
    alone, steps = found(bar, in_turn)
    by_one, by_three = Together(), Together(3)
    found(bar, by_one)
    shared, shared_steps = found(bar, by_three)
    same(shared, alone)
    assert shared_steps == steps
    assert len(by_three.widths) < 0.8 * len(by_one.widths)  # fewer waits for the same search
    assert sum(by_three.widths) > sum(by_one.widths)  # by runs of which some were not asked for


@pytest.mark.parametrize("most", [12, 25, 40])
def test_a_budget_that_ends_within_ends_at_the_same_run(bar: Scene, most: int) -> None:
    alone = found(bar, in_turn, most)[0]
    for processes in (1, 2):
        same(found(bar, Together(processes), most)[0], alone)


def test_a_journal_of_one_process_is_gone_on_from_by_many(bar: Scene) -> None:
    alone, steps = found(bar, in_turn)
    for cut in (1, 2, 3):  # within the descents that go side by side too
        journal = Journal("k", steps[cut - 1])
        same(calibrate(bar, CONFIG, journal=journal, runner=Together()), alone)


def test_it_can_be_cancelled_between_shared_simulations(bar: Scene) -> None:
    with Workers(2) as workers, pytest.raises(Cancelled, match="after 0 runs"):
        calibrate(bar, CONFIG, cancelled=lambda: True, runner=workers)
