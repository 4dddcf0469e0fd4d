"""Many who follow the same jobs: one reads for all of them, nothing is missed, and there is an end to how many."""

from __future__ import annotations

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest
from api_service import Service, assert_problem, scene_id

from physworld_services.api import feed
from physworld_services.api.feed import Feed
from physworld_storage.jobs import events

FOLLOWERS = 50
LONG = 3000


def _fit(client: httpx.Client) -> str:
    return str(client.post("/v1/fits", json={"scene_id": scene_id(client)}).json()["id"])


def _log(service: Service, job_id: str, count: int) -> None:
    with service.database.session() as session:
        for done in range(count):
            events.append_event(session, job_id, "progress", {"done": done, "total": count, "unit": "runs"})


def _followed(service: Service, job_id: str, after: int | None = None) -> list[dict[str, object]]:
    headers = {} if after is None else {"Last-Event-ID": str(after)}
    with service.client() as client:
        answer = client.get(f"/v1/jobs/{job_id}/events", headers=headers, timeout=120)
    assert answer.status_code == 200, answer.text
    lines = answer.text.splitlines()
    return [json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: ")]


def _kinds(found: list[dict[str, object]]) -> list[object]:
    return [event["type"] for event in found]


def test_fifty_followers_ask_the_database_as_often_as_one(
    service: Service, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[int] = []
    look = Feed._new

    def counted(self: Feed, after: dict[str, int]) -> object:
        looks.append(len(after))
        return look(self, after)

    monkeypatch.setattr(Feed, "_new", counted)
    job_id = _fit(client)
    with ThreadPoolExecutor(FOLLOWERS) as pool:
        followers = [pool.submit(_followed, service, job_id) for _ in range(FOLLOWERS)]
        while not looks:
            time.sleep(0.05)
        started, before = time.monotonic(), len(looks)
        time.sleep(2.0)
        most = (time.monotonic() - started) / feed.POLL_S + 2
        assert len(looks) - before <= most
        assert set(looks) == {1}
        service.work()
        heard = [follower.result() for follower in followers]
    assert all(events == heard[0] for events in heard)
    assert heard[0][-1]["data"] == {"state": "succeeded"}


def test_a_follower_from_the_start_of_a_long_job_is_spared_the_old_progress(
    service: Service, client: httpx.Client
) -> None:
    job_id = _fit(client)
    _log(service, job_id, LONG)
    service.work()
    begun = _followed(service, job_id)
    assert feed.RECENT <= len(begun) < feed.RECENT + 20
    assert [event["data"]["state"] for event in begun if event["type"] == "state"] == [
        "queued", "running", "succeeded",
    ]  # fmt: skip
    numbers = [event["seq"] for event in begun]
    assert numbers == sorted(set(numbers))
    resumed = _followed(service, job_id, after=int(str(begun[0]["seq"])))
    assert _kinds(resumed).count("progress") >= LONG


def test_a_follower_that_falls_behind_the_channel_misses_nothing(
    service: Service, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "RECENT", 5)
    monkeypatch.setattr(feed, "BATCH", 3)
    job_id = _fit(client)
    _log(service, job_id, 20)
    with ThreadPoolExecutor(1) as pool:
        follower = pool.submit(_followed, service, job_id, 0)
        for _ in range(5):
            time.sleep(0.1)
            _log(service, job_id, 20)
        service.work()
        heard = follower.result()
    assert _kinds(heard).count("progress") >= 120
    numbers = [event["seq"] for event in heard]
    assert numbers == sorted(set(numbers))
    assert numbers == [event["seq"] for event in _followed(service, job_id, 0)]


def test_there_is_an_end_to_how_many_streams_a_key_may_follow(
    service: Service, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "MOST_STREAMS_OF_A_KEY", 1)
    job_id = _fit(client)
    address = f"/v1/jobs/{job_id}/events"
    with client.stream("GET", address) as first:
        assert first.status_code == 200
        lines = first.iter_lines()  # kept: an iterator that is let go closes its stream
        next(lines)
        refused = client.get(address)
        assert_problem(refused, 429, "too_many_streams")
        assert refused.headers["Retry-After"] == "5"
        monkeypatch.setattr(feed, "MOST_STREAMS_OF_A_KEY", 100)
        monkeypatch.setattr(feed, "MOST_STREAMS", 1)
        assert_problem(client.get(address), 503, "too_many_streams")
    worker = threading.Thread(target=service.work)
    worker.start()
    monkeypatch.setattr(feed, "MOST_STREAMS", 400)
    assert _followed(service, job_id)[-1]["data"] == {"state": "succeeded"}
    worker.join()
