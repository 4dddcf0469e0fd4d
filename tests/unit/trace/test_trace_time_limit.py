"""The time that a trace is given: what is left, what is said of it, and what goes on from memory."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from sagging_bar import BUDGET, sagging

from physworld.calibrate import CalibrationConfig
from physworld.effects.registry import effect
from physworld.estimation.simulations import Drive, Job, Ledger, Simulations, TimeUp, Workers
from physworld.trace import Memory, TraceConfig, document, trace
from physworld.trace.answer import NAMED, NUMERICAL, UNEXPLAINED, Verdict
from physworld.trace.preparation import EXPERIMENT, SEARCH, Clock
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

CONFIG = TraceConfig(
    calibration=CalibrationConfig(particle_budget=BUDGET, damping="none"),
    candidates=("air_drag_linear", "gravity_tilt"),
    bootstraps=100,
    experiment=None,
)
NO_TIME_S = 1e-9


def test_a_search_is_left_when_its_time_is_up_but_what_is_remembered_is_found() -> None:
    scene = sagging()
    jobs = [Job(build_twin(scene, BUDGET), frames) for frames in (3, 4)]
    simulations = Simulations(Drive(*scene.control_track(), scene.times))
    first = simulations.run(jobs[:1])
    simulations.ledger.ends_at = 0.0
    with pytest.raises(TimeUp, match="after 1 simulations"):
        simulations.run(jobs[1:])
    with simulations.time_permitting("one"):
        assert simulations.run(jobs[:1])[0] is first[0]
    with simulations.time_permitting("two"):
        simulations.run(jobs)
    assert simulations.ledger.cut == ["two"]
    assert simulations.ledger.spent[""][0] == 1 and simulations.ledger.spent[""][1] > 0.0


def test_jobs_that_have_not_begun_never_do_once_time_is_up() -> None:
    scene = sagging()
    drive = Drive(*scene.control_track(), scene.times)
    jobs = [Job(build_twin(scene, BUDGET), scene.frame_count, share) for share in (1.0, *[0.02] * 20)]
    asked = 0

    def poll() -> None:
        nonlocal asked
        asked += 1
        if asked > 1:
            raise TimeUp

    with Workers(1) as workers:
        with pytest.raises(TimeUp):
            list(workers(jobs, drive, poll))
        waiting = [work for work in workers._pool._pending_work_items.values() if not work.future.cancelled()]
    assert len(waiting) < len(jobs) // 2  # those that the one process has been handed


def test_the_parts_of_a_trace_end_in_turn_and_the_searches_have_a_quarter_at_least() -> None:
    ledger = Ledger()
    clock = Clock(time.perf_counter() - 1000.0, 100.0, ledger)
    clock.start()
    begun = time.perf_counter()
    with clock.until(SEARCH):
        assert ledger.ends_at == pytest.approx(begun + 25.0 * SEARCH, abs=1.0)
    with clock.until(EXPERIMENT):
        assert ledger.ends_at == pytest.approx(begun + 25.0 * EXPERIMENT, abs=1.0)
    assert ledger.ends_at == float("inf")
    free = Clock(0.0, None, Ledger())
    free.start()
    with free.until(SEARCH):
        assert free.ledger.ends_at == float("inf")


def test_the_reason_tells_what_was_left_for_want_of_time() -> None:
    model: Any = SimpleNamespace(members=())
    clock = Clock(0.0, 60.0, Ledger())
    named = Verdict(NAMED, model, (), "best supported")
    assert clock.told(named) is named
    clock.ledger.cut += ["sensitivities", "fit with wind", "fit with wind"]
    left = "after 60 s these searches were left: sensitivities, fit with wind"
    assert clock.told(named) == replace(named, reason=f"best supported; {left}")


def test_a_trace_without_time_claims_nothing_and_with_all_remembered_what_it_claimed() -> None:
    scene, memory = sagging(effect("air_drag_linear", rate_per_s=4.0)), Memory()
    late = trace(scene, replace(CONFIG, time_limit_s=NO_TIME_S), memory=memory)
    assert late.verdict.name in (UNEXPLAINED, NUMERICAL) and "sensitivities" in late.verdict.reason
    assert late.held_out.before == late.held_out.after
    whole = trace(scene, CONFIG, memory=memory)
    assert whole.verdict.name == NAMED
    again = document(trace(scene, replace(CONFIG, time_limit_s=NO_TIME_S), memory=memory))
    assert again["reason"] == whole.verdict.reason
    stages = {stage["name"]: stage["simulations"] for stage in document(whole)["stages"]}
    assert stages["calibration"] > 0 and stages["fit with air_drag_linear"] > 0
    assert [stage["name"] for stage in again["stages"]] == ["calibration"]
