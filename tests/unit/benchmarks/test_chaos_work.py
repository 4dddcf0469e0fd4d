"""What the users of the chaos suite do with a pipeline that failed, against a service that answers as told."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import pytest
from physworld_client.errors import JobFailed, ServerError

from benchmarks.service.chaos import work
from benchmarks.service.chaos.work import Asked, Work
from physworld_schemas.base import Problem
from physworld_schemas.job import Job


def _job(state: str, detail: str = "") -> Job:
    error = Problem(title="failed", status=500, code="x", detail=detail) if detail else None
    return Job(id="job_1", kind="pipeline", state=state, created_at=datetime.now(UTC), error=error)


class Service:
    """A client whose ``wait`` ends as told, in turn; what was asked of it is in ``calls``."""

    def __init__(self, *ends: Job | Exception) -> None:
        self.calls: list[str] = []
        self._ends = list(ends)
        self.scenes = SimpleNamespace(create=lambda archive: SimpleNamespace(id="scn_1"))
        self.pipelines = SimpleNamespace(create=self._create)
        self.jobs = SimpleNamespace(wait=self._wait, retry=self._retry)

    def _create(self, body: object) -> Job:
        self.calls.append("create")
        return _job("queued")

    def _retry(self, job_id: str) -> Job:
        self.calls.append("retry")
        return _job("running")

    def _wait(self, job: Job, timeout: float) -> Job:
        end = self._ends.pop(0)
        if isinstance(end, Job) and end.state == "failed":
            raise JobFailed(end)
        if isinstance(end, Exception):
            raise end
        return end


def _asked(service: Service, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Asked:
    monkeypatch.setattr(work, "RETRY_AFTER_S", 0.0)
    monkeypatch.setattr(work, "PAUSE_S", 0.0)
    asked = Asked("bar-0003")
    Work(folder, "http://service", "key", 2)._one(service, asked)  # type: ignore[arg-type]
    return asked


def test_a_pipeline_that_was_refused_for_want_of_disk_is_retried_until_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused = _job("failed", "dataset job job_2: NotEnoughDisk: 24 episodes take about 1 MiB; 0 MiB are free")
    away = ServerError.__new__(ServerError)
    service = Service(refused, refused, away, _job("succeeded"))
    asked = _asked(service, tmp_path, monkeypatch)
    assert service.calls == ["create", "retry", "retry"]
    assert (asked.state, asked.retried, asked.asked_again) == ("succeeded", 2, 1)


def test_a_pipeline_that_failed_for_another_reason_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = Service(_job("failed", "StoreWriteFailed: nothing was written"))
    asked = _asked(service, tmp_path, monkeypatch)
    assert service.calls == ["create"]
    assert (asked.state, asked.retried) == ("failed", 0)
