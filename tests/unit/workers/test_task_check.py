"""A check in its real handler: what it stores, going on after a kill, and a number that the scene does not have."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from physworld_schemas.check import Check, CheckConfig, CheckCreate
from physworld_schemas.job import Job
from physworld_storage import checks
from physworld_storage.clock import CLOCK
from physworld_storage.jobs import jobs, leases
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.stores import Stores
from physworld_workers.tasks import check as task

pytestmark = pytest.mark.slow

SMALL = CheckConfig(candidates=["air_drag_linear", "adhesion"], particle_budget=60, motions=1)


def _open(stores: Stores, scene_id: str, config: CheckConfig = SMALL) -> Job:
    with stores.database.session() as session:
        return jobs.create_check(session, CheckCreate(scene_id=scene_id, config=config))


def _waiting(stores: Stores) -> list[str]:
    with stores.database.reading() as session:
        return [found.shard_id for found in leases.publishable(session)]


def _run(stores: Stores, runtime: Runtime) -> str:
    (driver,) = _waiting(stores)
    return run_shard(runtime, driver)


def _found(stores: Stores, job: Job) -> tuple[Job, Check]:
    with stores.database.reading() as session:
        return jobs.get_job(session, job.id), checks.get_check(session, job.outputs[0].id)


def test_a_check_stores_its_report(
    runtime_with: Callable[..., Runtime], stores: Stores, scene_id: str
) -> None:
    job = _open(stores, scene_id)
    assert _run(stores, runtime_with()) == "done"
    ended, check = _found(stores, job)
    assert ended.state == "succeeded" and check.state == "ready" and check.report is not None
    assert list(check.report.asked) == ["air_drag_linear"]
    assert "touches no ground" in check.report.refused["adhesion"]
    right, usual = check.report.views
    assert (right.discrepancy_m, usual.discrepancy_share) == (0.0, 0.03)
    modulus = usual.parameters[0]
    assert (
        modulus.name == "youngs_modulus_pa" and modulus.expected95[0] < modulus.value < modulus.expected95[1]
    )
    assert check.report.scene == "tiny bar" and check.lineage.inputs[0].id == scene_id
    assert ended.progress.unit == "simulations"


def test_a_killed_check_goes_on_without_repeating_simulations(
    runtime_with: Callable[..., Runtime], stores: Stores, scene_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = _open(stores, scene_id)
    (driver,) = _waiting(stores)
    keys: list[str] = []
    put = task.SharedMemory.put

    class Killed(BaseException):
        pass

    def dying(self: task.SharedMemory, key: str, tracks: np.ndarray | None) -> None:
        put(self, key, tracks)
        keys.append(key)
        if len(keys) == 3:
            raise Killed

    monkeypatch.setattr(task.SharedMemory, "put", dying)
    with pytest.raises(Killed):
        run_shard(runtime_with(), driver)
    before = set(keys)
    keys.clear()
    monkeypatch.setattr(
        task.SharedMemory, "put", lambda self, key, tracks: (keys.append(key), put(self, key, tracks))
    )
    with stores.database.session() as session:
        session.info[CLOCK] = lambda: datetime.now(UTC) + timedelta(minutes=5)
        leases.reap(session)
    assert run_shard(runtime_with(), driver) == "done"
    assert len(before) == 3 and not before & set(keys), "a simulation was run again"
    assert _found(stores, job)[1].state == "ready"


def test_a_number_that_the_scene_does_not_have_fails_the_check(
    runtime_with: Callable[..., Runtime], stores: Stores, scene_id: str
) -> None:
    job = _open(stores, scene_id, SMALL.model_copy(update={"values": {"bending_n_m": 1.0}}))
    assert _run(stores, runtime_with()) == "failed"
    ended, check = _found(stores, job)
    assert check.state == "failed" and check.report is None
    assert ended.error is not None and "no 'bending_n_m' to be calibrated" in (ended.error.detail or "")
