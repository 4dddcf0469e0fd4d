"""Idempotency-Key: once means once, also at the same time, also after a failure."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import httpx
from api_service import Service, assert_problem, bundle, scene_id, upload


def jobs_of(client: httpx.Client) -> int:
    return len(client.get("/v1/jobs", params={"limit": 200}).json()["data"])


def test_the_first_answer_is_replayed(client: httpx.Client) -> None:
    body = {"scene_id": scene_id(client)}
    headers = {"Idempotency-Key": "replay"}
    first = client.post("/v1/fits", json=body, headers=headers)
    before = jobs_of(client)
    again = client.post("/v1/fits", json={**body, "config": {}}, headers=headers)
    assert (again.status_code, again.content) == (first.status_code, first.content)
    assert again.headers["Location"] == first.headers["Location"]
    assert again.headers["Idempotent-Replayed"] == "true"
    assert "Idempotent-Replayed" not in first.headers
    assert jobs_of(client) == before


def test_another_body_or_address_is_refused(client: httpx.Client) -> None:
    body = {"scene_id": scene_id(client)}
    headers = {"Idempotency-Key": "other"}
    assert client.post("/v1/fits", json=body, headers=headers).status_code == 202
    changed = client.post("/v1/fits", json={**body, "config": {"max_simulations": 7}}, headers=headers)
    assert_problem(changed, 422, "idempotency_key_reused")
    assert_problem(client.post("/v1/pipelines", json=body, headers=headers), 422, "idempotency_key_reused")


def test_keys_of_two_people_do_not_meet(client: httpx.Client, service: Service) -> None:
    body = {"scene_id": scene_id(client)}
    headers = {"Idempotency-Key": "shared"}
    mine = client.post("/v1/fits", json=body, headers=headers).json()
    with service.client("write") as other:
        theirs = other.post("/v1/fits", json=body, headers=headers)
    assert theirs.json()["id"] != mine["id"]
    assert "Idempotent-Replayed" not in theirs.headers


def test_requests_at_the_same_time_work_once(client: httpx.Client, service: Service) -> None:
    body = {"scene_id": scene_id(client)}
    before = jobs_of(client)

    def post(_: int) -> httpx.Response:
        with service.client() as own:
            return own.post("/v1/fits", json=body, headers={"Idempotency-Key": "together"})

    with ThreadPoolExecutor(6) as pool:
        answers = list(pool.map(post, range(6)))
    assert {answer.status_code for answer in answers} == {202}
    assert len({answer.json()["id"] for answer in answers}) == 1
    assert sum("Idempotent-Replayed" not in answer.headers for answer in answers) == 1
    assert jobs_of(client) == before + 1


def test_a_failure_leaves_the_key_free(client: httpx.Client) -> None:
    headers = {"Idempotency-Key": "second-try"}
    assert_problem(client.post("/v1/fits", json={"scene_id": "scn_none"}, headers=headers), 404, "not_found")
    assert client.post("/v1/fits", json={"scene_id": scene_id(client)}, headers=headers).status_code == 202


def test_upload_is_the_same_whatever_its_boundary(client: httpx.Client) -> None:
    client.headers["Idempotency-Key"] = "upload"
    data = bundle("keyed")
    first = upload(client, data)
    again = upload(client, data)
    assert first.status_code == again.status_code == 201
    assert again.headers["Idempotent-Replayed"] == "true"
    assert again.content == first.content
    assert_problem(upload(client, bundle("keyed", seed=5)), 422, "idempotency_key_reused")


def test_cancel_is_replayed_too(client: httpx.Client) -> None:
    job = client.post("/v1/fits", json={"scene_id": scene_id(client)}).json()
    headers = {"Idempotency-Key": "cancel"}
    first = client.post(f"/v1/jobs/{job['id']}/cancel", headers=headers)
    assert client.post(f"/v1/jobs/{job['id']}/cancel", headers=headers).content == first.content


def test_unusable_keys_are_refused(client: httpx.Client) -> None:
    body = {"scene_id": scene_id(client)}
    for key in ("a b", "x" * 129, "é"):
        response = client.post("/v1/fits", json=body, headers={"Idempotency-Key": key.encode()})  # type: ignore[arg-type]
        assert_problem(response, 422, "invalid_request")
