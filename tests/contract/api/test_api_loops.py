"""Loops over HTTP: accepted once, followed to the next version, ended where there is nothing, refused with reasons."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from api_service import Service, assert_problem, bundle, scene_id, upload


@pytest.fixture(autouse=True)
def usual_answers(service: Service) -> Iterator[None]:
    service.outcome = "worse_than_expected"
    yield
    service.verdict, service.outcome = "named", "as_expected"


@pytest.fixture(scope="module")
def home(service: Service) -> str:
    """The recording of a model ``looped`` with one version."""
    with service.client() as client:
        home = scene_id(client, "looped")
        body = {"scene_id": home, "dataset": {"episodes": 1}, "training": {"steps": 5}}
        assert client.post("/v1/pipelines", json=body).status_code == 202
        service.work()
    return home


def begun(client: httpx.Client, body: dict[str, Any], **headers: str) -> dict[str, Any]:
    response = client.post("/v1/loops", json=body, headers=headers)
    assert response.status_code == 202, response.text
    job: dict[str, Any] = response.json()
    assert response.headers["Location"] == f"/v1/jobs/{job['id']}"
    return job


def test_a_loop_ends_in_the_next_version_with_the_errors_of_both(
    client: httpx.Client, service: Service, home: str
) -> None:
    new = scene_id(client, "looped elsewhere")
    body = {"model": "looped", "version": 1, "scene_id": new, "trace": {"iterations": 3}}
    key = {"Idempotency-Key": "loop-once"}
    job = begun(client, body, **key)
    assert begun(client, body, **key) == job
    waiting = client.get(f"/v1/loops/{job['id']}").json()
    assert (waiting["state"], waiting["outcome"], waiting["new_version"]) == ("queued", None, None)
    service.work()
    loop = client.get(f"/v1/loops/{job['id']}").json()
    assert (loop["state"], loop["outcome"], loop["verdict"]) == ("succeeded", "improved", "named")
    assert (loop["version"], loop["before"]["version"], loop["scene_id"]) == (1, 1, new)
    assert loop["new_version"] == loop["after"]["version"] > 1
    assert (loop["before"]["measured"]["error_m"], loop["gain_ci95_m"]) == (5e-3, [2e-3, 4e-3])
    for name, link in loop["links"].items():
        answer = client.get(link)
        assert answer.status_code == 200, (name, answer.text)
    trace = client.get(loop["links"]["trace"]).json()
    assert (trace["scene_id"], trace["scene_ids"], trace["config"]["iterations"]) == (home, [new], 3)
    version = client.get(loop["links"]["new_version"]).json()
    assert (version["trace_id"], version["config"]["steps"]) == (trace["id"], 5)
    comparison = client.get(loop["links"]["comparison"]).json()
    assert comparison["config"]["frames"] == "held_out" and comparison["compared"]["version"] == 1
    kinds = [item["kind"] for item in client.get(f"/v1/jobs/{job['id']}").json()["outputs"]]
    assert kinds == ["assessment", "trace", "dataset", "model", "assessment"]
    listed = client.get("/v1/loops", params={"model": "looped", "state": "succeeded"}).json()["data"]
    assert loop in listed
    assert client.get("/v1/loops", params={"model": "nobody"}).json()["data"] == []


def test_it_goes_on_from_an_assessment_and_ends_where_no_effect_is_found(
    client: httpx.Client, service: Service, home: str
) -> None:
    service.verdict = "unexplained"
    address = "/v1/models/looped/versions/1/assessments"
    held = client.post(
        address, json={"scene_id": scene_id(client, "looped again"), "open_trace": False}
    ).json()
    known = held["outputs"][0]["id"]
    assert_problem(client.post("/v1/loops", json={"assessment_id": known}), 409, "conflict")
    service.work()
    newest = client.get("/v1/models/looped").json()["latest_version"]
    job = begun(client, {"assessment_id": known})
    service.work()
    loop = client.get(f"/v1/loops/{job['id']}").json()
    assert (loop["outcome"], loop["verdict"], loop["assessment_id"]) == ("no_effect", "unexplained", known)
    assert loop["new_version"] is None and "unexplained" in loop["reason"]
    assert client.get("/v1/models/looped").json()["latest_version"] == newest


def test_a_model_that_keeps_its_promise_ends_the_loop(
    client: httpx.Client, service: Service, home: str
) -> None:
    service.outcome = "within_noise"
    job = begun(client, {"model": "looped", "version": 1, "scene_id": scene_id(client, "looped calmly")})
    service.work()
    loop = client.get(f"/v1/loops/{job['id']}").json()
    assert (loop["outcome"], loop["trace_id"], loop["state"]) == ("as_expected", None, "succeeded")
    refused = client.post("/v1/loops", json={"assessment_id": loop["assessment_id"]})
    assert "nothing to close a loop on" in assert_problem(refused, 409, "conflict")["detail"]


def test_a_loop_is_refused_with_its_reason(client: httpx.Client, service: Service, home: str) -> None:
    own = {"model": "looped", "version": 1, "scene_id": home}
    assert (
        "needs another one" in assert_problem(client.post("/v1/loops", json=own), 409, "conflict")["detail"]
    )
    block = upload(client, bundle("looped block", kind="block"))
    assert block.status_code == 201, block.text
    other = client.post("/v1/loops", json={**own, "scene_id": block.json()["id"]})
    assert "shows a block" in assert_problem(other, 409, "conflict")["detail"]
    for body in ({**own, "scene_id": "scn_none"}, {**own, "model": "nobody"}, {"assessment_id": "ass_none"}):
        assert_problem(client.post("/v1/loops", json=body), 404, "not_found")
    for body in ({}, {"model": "looped"}, {**own, "wish": 1}, {**own, "assessment_id": "ass_x"}):
        assert_problem(client.post("/v1/loops", json=body), 422, "invalid_request")
    unknown = {**own, "trace": {"candidates": ["phlogiston"]}}
    assert_problem(client.post("/v1/loops", json=unknown), 422, "invalid_request")
    assert_problem(client.get("/v1/loops/job_none"), 404, "not_found")
    assert_problem(client.get("/v1/loops", params={"cursor": "x"}), 422, "invalid_cursor")


def test_a_loop_is_cancelled_with_its_children(client: httpx.Client, service: Service, home: str) -> None:
    body = {"model": "looped", "version": 1, "scene_id": scene_id(client, "looped in vain")}
    job = begun(client, body)
    service.work(1)
    assert client.post(f"/v1/jobs/{job['id']}/cancel").json()["state"] == "cancelled"
    loop = client.get(f"/v1/loops/{job['id']}").json()
    assert (loop["state"], loop["outcome"]) == ("cancelled", None)
    assert client.get(loop["links"]["trace"]).json()["state"] == "cancelled"
    with service.client("read") as reader:
        assert reader.get(f"/v1/loops/{job['id']}").status_code == 200
        assert_problem(reader.post("/v1/loops", json=body), 403, "forbidden")
