"""Waiting for jobs: events, progress, timeouts, failures; and the retries below."""

from __future__ import annotations

import threading
from pathlib import Path

import httpx
import pytest
from physworld_client import Client, transport
from physworld_client.errors import (
    ConnectionFailed,
    DigestMismatch,
    InvalidRequest,
    JobCancelled,
    JobFailed,
    NotFound,
    RequestTimedOut,
    WaitTimedOut,
)
from sdk_service import Service, write_scene

from physworld_schemas.base import Problem
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.job import Job


class Faulty(httpx.HTTPTransport):
    """A real connection on which chosen requests go wrong.

    Attributes:
        faults: what happens to the next requests: "refuse" (nothing is sent), "lose" (the answer is lost),
            "cut" (the body breaks off in the middle), "503", "timeout", or "" for none.
        sent: the requests that reached the service.
    """

    def __init__(self, *faults: str) -> None:
        super().__init__()
        self.faults = list(faults)
        self.sent: list[httpx.Request] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        fault = self.faults.pop(0) if self.faults else ""
        if fault == "refuse":
            raise httpx.ConnectError("refused", request=request)
        if fault == "timeout":
            raise httpx.ReadTimeout("too slow", request=request)
        if fault == "503":
            return httpx.Response(503, headers={"Retry-After": "0"}, text="starting", request=request)
        response = super().handle_request(request)
        self.sent.append(request)
        if fault == "lose":
            response.close()
            raise httpx.RemoteProtocolError("the line broke", request=request)
        if fault == "cut":
            assert isinstance(response.stream, httpx.SyncByteStream)
            response.stream = _Cut(response.stream)
        return response


class _Cut(httpx.SyncByteStream):
    """A body that breaks off after its first piece."""

    def __init__(self, stream: httpx.SyncByteStream) -> None:
        self.stream = stream

    def __iter__(self):  # type: ignore[no-untyped-def]
        for piece in self.stream:
            yield piece
            raise httpx.ReadError("the line broke")

    def close(self) -> None:
        self.stream.close()


@pytest.fixture(autouse=True)
def quick_retries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Retries without their pauses; how long these are is tested beside the code."""
    monkeypatch.setattr(transport, "RETRY_BASE_S", 0.001)


@pytest.fixture
def scene_id(client: Client, tmp_path: Path) -> str:
    """An uploaded scene."""
    return client.scenes.create(write_scene(tmp_path / "scene")).id


def test_waiting_follows_the_progress(service: Service, client: Client, scene_id: str) -> None:
    fit = client.fits.create(scene_id)
    service.work()
    job = client.datasets.create(client.jobs.wait(fit).outputs[0].id, DatasetConfig(episodes=5))
    seen: list[Job] = []
    worker: list[threading.Thread] = []

    def look(job: Job) -> None:
        seen.append(job)
        if not worker:
            worker.append(threading.Thread(target=service.work))
            worker[0].start()

    done = client.jobs.wait(job, timeout=60, on_progress=look)
    worker[0].join()
    assert seen[0].state == "queued"
    assert seen[-1] == done
    assert (done.progress.done, done.progress.total, done.progress.unit) == (5, 5, "episodes")
    counts = [job.progress.done for job in seen]
    assert counts == sorted(counts)


def test_waiting_goes_on_without_the_event_stream(service: Service, scene_id: str) -> None:
    broken = Faulty("", "refuse")
    with service.client(transport=broken) as client:
        job = client.fits.create(scene_id)
        broken.faults = ["", "refuse"]
        worker = threading.Timer(0.3, service.work)
        worker.start()
        assert client.jobs.wait(job, timeout=60).state == "succeeded"
        worker.join()
    assert any("wait" in request.url.params for request in broken.sent)


def test_patience_ends_and_the_job_goes_on(service: Service, client: Client, scene_id: str) -> None:
    job = client.fits.create(scene_id)
    with pytest.raises(WaitTimedOut, match="still queued") as caught:
        client.jobs.wait(job, timeout=0.2)
    assert caught.value.job.id == job.id
    service.work()
    assert client.jobs.wait(job, timeout=30).state == "succeeded"


def test_a_failed_job_raises_its_problem_with_its_numbers(
    service: Service, client: Client, scene_id: str
) -> None:
    job = client.fits.create(scene_id)
    detail = "dt 1.0e-4 s exceeds the CFL limit 6.1e-5 s"
    service.fail(Problem(title="Unstable", status=422, code="cfl_violation", detail=detail))
    with pytest.raises(JobFailed, match=r"fit job job_\w+ failed: dt 1.0e-4 s exceeds .* \[cfl_violation\]"):
        client.jobs.wait(job, timeout=30)


def test_a_cancelled_job_says_so(client: Client, scene_id: str) -> None:
    job = client.fits.create(scene_id)
    assert client.jobs.cancel(job.id).state in {"cancelling", "cancelled"}
    with pytest.raises(JobCancelled, match=job.id):
        client.jobs.wait(job, timeout=30)


def test_events_are_resumed_after_a_break_without_loss_or_repetition(
    service: Service, client: Client, scene_id: str
) -> None:
    job = client.fits.create(scene_id)
    service.work()
    whole = [event.seq for event in client.jobs.events(job.id)]
    assert len(whole) >= 3
    with service.client(transport=Faulty("cut", "refuse", "lose")) as faulty:
        assert [event.seq for event in faulty.jobs.events(job.id)] == whole
    assert [event.seq for event in client.jobs.events(job.id, after=whole[0])] == whole[1:]
    assert list(client.jobs.events(job.id, after=whole[-1])) == []


def test_events_of_an_unknown_job_are_not_retried(service: Service) -> None:
    line = Faulty()
    with service.client(transport=line) as client, pytest.raises(NotFound):
        list(client.jobs.events("job_01ARZ3NDEKTSV4RRFFQ69G5FAV"))
    assert len(line.sent) == 1


def test_a_post_whose_answer_was_lost_starts_its_work_once(service: Service, scene_id: str) -> None:
    line = Faulty("lose", "503", "")
    with service.client(transport=line) as client:
        before = len(list(client.jobs.list(limit=200).auto_paging_iter()))
        line.faults = ["lose", "503", ""]
        job = client.fits.create(scene_id)
        sent = [request for request in line.sent if request.method == "POST"]
        assert len(sent) == 2
        assert len({request.headers["Idempotency-Key"] for request in sent}) == 1
        after = list(client.jobs.list(limit=200).auto_paging_iter())
    assert len(after) == before + 1
    assert after[0].id == job.id
    service.work()


def test_an_upload_whose_answer_was_lost_is_repeated_byte_for_byte(service: Service, tmp_path: Path) -> None:
    line = Faulty("lose")
    folder = write_scene(tmp_path / "again", "again", seed=77)
    with service.client(transport=line) as client:
        scene = client.scenes.create(folder)
        named = [found for found in client.scenes.list(limit=200).auto_paging_iter() if found.name == "again"]
    assert [found.id for found in named] == [scene.id]


@pytest.mark.parametrize(("fault", "kind"), [("refuse", ConnectionFailed), ("timeout", RequestTimedOut)])
def test_retries_end(service: Service, fault: str, kind: type[Exception]) -> None:
    with service.client(transport=Faulty(*[fault] * 9), max_retries=2) as client:
        with pytest.raises(kind, match="3 attempts"):
            client.scenes.list()


def test_a_fault_of_the_caller_is_not_retried(service: Service) -> None:
    line = Faulty()
    with service.client(transport=line) as client, pytest.raises(InvalidRequest):
        client.scenes.list(limit=100_000)
    assert len(line.sent) == 1


def test_a_download_that_breaks_off_is_resumed(service: Service, scene_id: str, tmp_path: Path) -> None:
    line = Faulty()
    with service.client(transport=line) as client:
        job = client.fits.create(scene_id)
        service.work()
        artifact = client.fits.get(client.jobs.wait(job).outputs[0].id).artifacts[0]
        line.sent.clear()
        line.faults = ["cut", "refuse", "cut", "503", ""]
        path = client.artifacts.download(artifact, tmp_path / "twin.npz")
        assert path.stat().st_size == artifact.size
        offsets = [int(request.headers.get("Range", "bytes=0-")[6:-1]) for request in line.sent]
        assert offsets[0] == 0
        assert offsets == sorted(set(offsets))
        assert len(offsets) == 3
        line.sent.clear()
        client.artifacts.download(artifact.sha256, path)
        assert line.sent == [], "what is there already is not fetched again"


def test_a_spoilt_part_is_noticed_and_the_next_download_succeeds(
    service: Service, client: Client, scene_id: str, tmp_path: Path
) -> None:
    job = client.fits.create(scene_id)
    service.work()
    artifact = client.fits.get(client.jobs.wait(job).outputs[0].id).artifacts[0]
    part = tmp_path / f".twin.npz.{artifact.sha256[:16]}.part"
    part.write_bytes(b"not these bytes")
    with pytest.raises(DigestMismatch, match=artifact.sha256):
        client.artifacts.download(artifact, tmp_path / "twin.npz")
    assert list(tmp_path.glob("*twin*")) == []
    assert client.artifacts.download(artifact, tmp_path / "twin.npz").stat().st_size == artifact.size


def test_an_unknown_artifact_is_not_found(client: Client, tmp_path: Path) -> None:
    with pytest.raises(NotFound):
        client.artifacts.download("0" * 64, tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()
