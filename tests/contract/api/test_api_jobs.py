"""Jobs: accepted, waited for, followed, cancelled; pages of them."""

from __future__ import annotations

import json
import threading
import time

import httpx
import pytest
from api_service import Service, assert_problem, scene_id

from physworld_schemas.base import Problem
from physworld_services.api import sse
from physworld_storage.jobs import leases

WAIT_S = 20.0


def pipeline(client: httpx.Client, name: str, episodes: int = 2) -> dict[str, object]:
    body = {"scene_id": scene_id(client, name), "dataset": {"episodes": episodes}}
    response = client.post("/v1/pipelines", json=body)
    assert response.status_code == 202, response.text
    return response.json()  # type: ignore[no-any-return]


def frames(text: str) -> list[dict[str, str]]:
    """The events of a stream's text, comments left out."""
    blocks = [
        block for block in text.replace("\r\n", "\n").split("\n\n") if block and not block.startswith(":")
    ]
    return [dict(line.split(": ", 1) for line in block.splitlines()) for block in blocks]


def test_work_is_accepted_with_its_address(client: httpx.Client, service: Service) -> None:
    response = client.post("/v1/fits", json={"scene_id": scene_id(client)})
    job = response.json()
    assert response.status_code == 202
    assert response.headers["Location"] == f"/v1/jobs/{job['id']}" == job["links"]["self"]
    assert int(response.headers["Retry-After"]) >= 1
    assert (job["kind"], job["state"]) == ("fit", "queued")
    fit = client.get(job["links"]["fit"]).json()
    assert (fit["state"], fit["job_id"]) == ("pending", job["id"])
    assert service.work() == 1
    assert client.get(job["links"]["fit"]).json()["state"] == "ready"


def test_the_whole_chain_in_one_call(client: httpx.Client, service: Service) -> None:
    job = pipeline(client, "whole chain", episodes=3)
    assert service.work() == 7  # fit, plan, three episodes, seal, training
    done = client.get(f"/v1/jobs/{job['id']}").json()
    assert done["state"] == "succeeded"
    assert [client.get(f"/v1/jobs/{child}").json()["kind"] for child in done["children"]] == [
        "fit",
        "dataset",
        "training",
    ]
    version = client.get(done["links"]["model"]).json()
    assert (version["name"], version["version"], version["state"]) == ("whole-chain", 1, "ready")
    dataset = client.get(f"/v1/datasets/{version['dataset_id']}").json()
    assert (dataset["state"], dataset["episodes_done"]) == ("sealed", 3)


def test_long_poll_ends_with_the_job(client: httpx.Client, service: Service) -> None:
    job = client.post("/v1/fits", json={"scene_id": scene_id(client)}).json()
    worker = threading.Timer(0.4, service.work)
    worker.start()
    started = time.monotonic()
    done = client.get(f"/v1/jobs/{job['id']}", params={"wait": WAIT_S}).json()
    assert done["state"] == "succeeded"
    assert time.monotonic() - started < WAIT_S
    worker.join()


def test_long_poll_answers_after_its_time(client: httpx.Client) -> None:
    job = client.post("/v1/fits", json={"scene_id": scene_id(client)}).json()
    assert client.get(f"/v1/jobs/{job['id']}", params={"wait": 0.3}).json()["state"] == "queued"
    for wait in ("-1", "61", "nan", "inf", "soon"):
        assert_problem(client.get(f"/v1/jobs/{job['id']}", params={"wait": wait}), 422, "invalid_request")
    client.post(f"/v1/jobs/{job['id']}/cancel")


def test_events_are_followed_to_the_end_and_resumed(client: httpx.Client, service: Service) -> None:
    job = pipeline(client, "followed")
    worker = threading.Timer(0.3, service.work)
    worker.start()
    address = f"/v1/jobs/{job['id']}/events"
    with client.stream("GET", address) as response:
        assert response.headers["Content-Type"].startswith("text/event-stream")
        events = frames(response.read().decode())
    worker.join()
    ids = [int(event["id"]) for event in events]
    assert ids == sorted(set(ids))
    data = [json.loads(event["data"]) for event in events]
    assert all(
        item["seq"] == number and item["job_id"] == job["id"] for item, number in zip(data, ids, strict=True)
    )
    states = [item["data"]["state"] for item in data if item["type"] == "state"]
    assert (states[0], states[-1]) == ("queued", "succeeded")

    middle = len(ids) // 2
    resumed = client.get(address, headers={"Last-Event-ID": str(ids[middle])})
    assert frames(resumed.text) == events[middle + 1 :]
    assert client.get(address, headers={"Last-Event-ID": str(ids[-1])}).status_code == 204


def test_events_of_a_quiet_job_carry_a_heartbeat(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sse, "HEARTBEAT_S", 0.2)
    job = client.post("/v1/fits", json={"scene_id": scene_id(client)}).json()
    with client.stream("GET", f"/v1/jobs/{job['id']}/events") as response:
        for line in response.iter_lines():
            if line.startswith(": heartbeat"):
                break
    client.post(f"/v1/jobs/{job['id']}/cancel")


def test_events_refuse_a_wrong_place(client: httpx.Client) -> None:
    assert_problem(client.get("/v1/jobs/job_none/events"), 404, "not_found")
    job = client.get("/v1/jobs", params={"limit": 1}).json()["data"][0]
    for place in ("x", "-1", str(2**70)):
        refused = client.get(f"/v1/jobs/{job['id']}/events", headers={"Last-Event-ID": place})
        assert_problem(refused, 422, "invalid_request")


def test_cancel_reaches_children_and_is_harmless_twice(client: httpx.Client, service: Service) -> None:
    job = pipeline(client, "cancelled")
    for _ in range(2):
        response = client.post(f"/v1/jobs/{job['id']}/cancel")
        assert response.status_code == 202
        assert response.json()["state"] in ("cancelling", "cancelled")
    child = job["children"][0]  # type: ignore[index]
    assert client.get(f"/v1/jobs/{child}").json()["state"] == "cancelled"
    assert service.claim() is None
    assert_problem(client.post("/v1/jobs/job_none/cancel"), 404, "not_found")


def test_a_job_that_succeeded_cannot_be_cancelled(client: httpx.Client, service: Service) -> None:
    job = client.post("/v1/fits", json={"scene_id": scene_id(client)}).json()
    service.work()
    assert_problem(client.post(f"/v1/jobs/{job['id']}/cancel"), 409, "conflict")


def test_a_failed_job_is_retried_once_and_goes_on(client: httpx.Client, service: Service) -> None:
    job = pipeline(client, "retried")
    again = f"/v1/jobs/{job['id']}/retry"
    assert_problem(client.post(again), 409, "conflict")
    service.work(2)  # fit, plan
    lease = service.claim()
    assert lease is not None
    problem = Problem(title="Boom", status=500, code="boom", detail="12 of 400 nodes are not finite")
    with service.database.session() as session:
        leases.fail(session, lease, problem, retry=False)
    assert client.get(f"/v1/jobs/{job['id']}").json()["state"] == "failed"
    answers = [client.post(again, headers={"Idempotency-Key": "again"}) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [202, 202]
    assert answers[0].content == answers[1].content and answers[0].json()["state"] == "running"
    assert client.get("/v1/audit").json()["data"][0]["action"] == "job.retried"
    service.work()
    assert client.get(f"/v1/jobs/{job['id']}").json()["state"] == "succeeded"
    assert_problem(client.post("/v1/jobs/job_none/retry"), 404, "not_found")


def test_work_needs_its_input_ready(client: httpx.Client) -> None:
    job = client.post("/v1/fits", json={"scene_id": scene_id(client)}).json()
    fit = job["outputs"][0]["id"]
    assert_problem(client.post("/v1/datasets", json={"fit_id": fit}), 409, "conflict")
    assert_problem(client.post("/v1/datasets", json={"fit_id": "fit_none"}), 404, "not_found")
    assert_problem(client.post("/v1/models", json={"name": "m", "dataset_id": "dst_none"}), 404, "not_found")
    client.post(f"/v1/jobs/{job['id']}/cancel")


def test_pages_walk_over_every_job_once(client: httpx.Client) -> None:
    scene = scene_id(client)
    made = [client.post("/v1/fits", json={"scene_id": scene}).json()["id"] for _ in range(5)]
    for job in made:
        client.post(f"/v1/jobs/{job}/cancel")
    seen: list[str] = []
    query: dict[str, str | int] = {"limit": 2, "kind": "fit"}
    while True:
        page = client.get("/v1/jobs", params=query).json()
        seen += [job["id"] for job in page["data"]]
        assert len(page["data"]) <= 2
        if not page["has_more"]:
            assert page["next_cursor"] is None
            break
        query["cursor"] = page["next_cursor"]
    assert len(seen) == len(set(seen))
    assert seen[:5] == made[::-1]


def test_lists_filter_and_refuse_what_they_do_not_know(client: httpx.Client) -> None:
    states = {job["state"] for job in client.get("/v1/jobs", params={"state": "cancelled"}).json()["data"]}
    assert states == {"cancelled"}
    for query in ({"state": "lost"}, {"limit": 0}, {"limit": 201}, {"kind": "magic"}):
        assert_problem(client.get("/v1/jobs", params=query), 422, "invalid_request")
    for cursor in ("x", "!!", "W10", "bnVsbA", "A" * 512):
        assert_problem(client.get("/v1/jobs", params={"cursor": cursor}), 422, "invalid_cursor")
