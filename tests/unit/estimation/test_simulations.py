"""What a remembered simulation belongs to: the twin, its drive and the engine."""

from __future__ import annotations

import time
from multiprocessing import active_children

import pytest
from tiny_scene import tiny_scene

from physworld.errors import WorkerLost
from physworld.estimation import simulations
from physworld.estimation.simulations import Drive, Job, Workers, engine
from physworld.twin.build import build_twin


def test_the_fingerprint_of_a_job_changes_with_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene()
    drive = Drive(*scene.control_track(), scene.times).digest()
    job = Job(build_twin(scene, 60), 3)
    known = job.fingerprint(drive)
    assert known == Job(build_twin(scene, 60), 3).fingerprint(drive)
    monkeypatch.setattr(simulations, "engine", lambda: "another")
    assert job.fingerprint(drive) != known


def test_the_engine_is_the_same_each_time_and_quick_to_read() -> None:
    taken = []
    for _ in range(3):
        engine.cache_clear()
        begun = time.perf_counter()
        found = engine()
        taken.append(time.perf_counter() - begun)
        assert found == engine()
    assert min(taken) < 0.1, f"{taken} s"


def test_a_process_that_is_killed_is_a_typed_error() -> None:
    scene = tiny_scene()
    drive = Drive(*scene.control_track(), scene.times)
    jobs = [Job(build_twin(scene, 60), 3)]
    with Workers(1) as workers:
        assert len(list(workers(jobs, drive, lambda: None))) == 1
        (child,) = active_children()
        child.kill()
        child.join()
        with pytest.raises(WorkerLost, match="1 processes"):
            list(workers(jobs, drive, lambda: None))
