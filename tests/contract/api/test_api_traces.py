"""Traces and assessments over HTTP, and the pipeline that closes the loop."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from api_service import REPORT, TRACKS, Service, assert_problem, bundle, scene_id, upload

from physworld_schemas.trace import TraceCreate


@pytest.fixture(autouse=True)
def usual_answers(service: Service) -> Iterator[None]:
    yield
    service.verdict, service.outcome = "named", "as_expected"


def made(client: httpx.Client, address: str, body: dict[str, Any], kind: str) -> tuple[dict[str, Any], str]:
    """A job and the id of what it will make."""
    response = client.post(address, json=body)
    assert response.status_code == 202, response.text
    job = response.json()
    return job, next(item["id"] for item in job["outputs"] if item["kind"] == kind)


def pipeline(client: httpx.Client, name: str, **more: Any) -> dict[str, Any]:
    body = {"scene_id": scene_id(client, name), "dataset": {"episodes": 1}, **more}
    response = client.post("/v1/pipelines", json=body)
    assert response.status_code == 202, response.text
    return response.json()  # type: ignore[no-any-return]


def kinds(client: httpx.Client, job_id: str) -> list[str]:
    job = client.get(f"/v1/jobs/{job_id}").json()
    assert job["state"] == "succeeded", job
    return [client.get(f"/v1/jobs/{child}").json()["kind"] for child in job["children"]]


def test_a_trace_is_accepted_and_answers_with_its_report(client: httpx.Client, service: Service) -> None:
    scene = scene_id(client)
    body = {"scene_id": scene, "config": {"candidates": ["air_drag_linear"], "iterations": 2}}
    job, trace_id = made(client, "/v1/traces", body, "trace")
    assert job["links"]["trace"] == f"/v1/traces/{trace_id}"
    pending = client.get(f"/v1/traces/{trace_id}").json()
    assert (pending["state"], pending["verdict"], pending["held_out"]) == ("pending", None, None)
    assert_problem(client.get(f"/v1/traces/{trace_id}/tracks"), 409, "conflict")
    assert service.work() == 1
    trace = client.get(f"/v1/traces/{trace_id}").json()
    assert {key: trace[key] for key in REPORT} == REPORT
    assert (trace["state"], trace["verdict"], trace["scene_id"]) == ("ready", "named", scene)
    assert trace["config"]["iterations"] == 2
    listed = client.get("/v1/traces", params={"scene_id": scene, "verdict": "named", "state": "ready"})
    assert trace_id in [item["id"] for item in listed.json()["data"]]
    assert client.get("/v1/traces", params={"verdict": "unexplained"}).json()["data"] == []
    answer = client.get(f"/v1/traces/{trace_id}/tracks")
    with np.load(io.BytesIO(answer.content), allow_pickle=False) as arrays:
        for name, array in TRACKS.items():
            np.testing.assert_array_equal(arrays[name], array)


def test_a_trace_of_several_recordings_says_which_are_fitted_and_which_held_out(
    client: httpx.Client, service: Service
) -> None:
    first, second, unseen = (scene_id(client, f"strip {k}") for k in "abc")
    body = {"scene_id": first, "scene_ids": [second], "held_out_scene_ids": [unseen]}
    job, trace_id = made(client, "/v1/traces", body, "trace")
    assert [item["id"] for item in job["inputs"]] == [first, second, unseen]
    for _ in range(2):
        trace = client.get(f"/v1/traces/{trace_id}").json()
        assert {key: trace[key] for key in body} == body
        service.work()
    assert trace["state"] == "ready"
    twice = client.post("/v1/traces", json={**body, "held_out_scene_ids": [first]})
    assert_problem(twice, 422, "invalid_request")
    assert first in twice.text
    assert_problem(client.post("/v1/traces", json={**body, "scene_ids": ["scn_none"]}), 404, "not_found")


def test_a_fit_of_several_recordings_says_which(client: httpx.Client, service: Service) -> None:
    first, second = (scene_id(client, f"cord {k}") for k in "ab")
    body = {"scene_id": first, "scene_ids": [second]}
    job, fit_id = made(client, "/v1/fits", body, "fit")
    assert [item["id"] for item in job["inputs"]] == [first, second]
    for _ in range(2):
        fit = client.get(f"/v1/fits/{fit_id}").json()
        assert {key: fit[key] for key in body} == body and "scene_ids" not in fit["metrics"]
        service.work()
    assert fit["state"] == "ready"
    assert_problem(client.post("/v1/fits", json={**body, "scene_ids": [first]}), 422, "invalid_request")
    field = client.post("/v1/fits", json={**body, "config": {"stages": "global+local"}})
    assert_problem(field, 422, "invalid_request")
    assert "fits a field to one recording" in field.text
    assert_problem(client.post("/v1/fits", json={**body, "scene_ids": ["scn_none"]}), 404, "not_found")


def test_a_pipeline_fits_and_traces_several_recordings(client: httpx.Client, service: Service) -> None:
    second = scene_id(client, "cord c")
    job = pipeline(client, "cord d", scene_ids=[second], close_the_loop=True, compare=False)
    assert [item["id"] for item in job["inputs"]][1:] == [second]
    service.work()
    children = [
        client.get(f"/v1/jobs/{child}").json()
        for child in client.get(f"/v1/jobs/{job['id']}").json()["children"]
    ]
    asked = {
        child["kind"]: [item["id"] for item in child["inputs"] if item["kind"] == "scene"]
        for child in children
    }
    assert asked["fit"] == asked["trace"] == [job["inputs"][0]["id"], second]


def test_traces_are_refused_cancelled_and_done_once(client: httpx.Client, service: Service) -> None:
    scene = scene_id(client)
    assert_problem(client.post("/v1/traces", json={"scene_id": "scn_none"}), 404, "not_found")
    assert_problem(client.post("/v1/traces", json={"scene_id": scene, "wish": 1}), 422, "invalid_request")
    fit = client.post("/v1/fits", json={"scene_id": scene}).json()
    fit_id = fit["outputs"][0]["id"]
    assert_problem(client.post("/v1/traces", json={"scene_id": scene, "fit_id": fit_id}), 409, "conflict")
    service.work()
    block = upload(client, bundle("a block", kind="block")).json()["id"]
    refused = client.post("/v1/traces", json={"scene_id": block, "fit_id": fit_id})
    assert "is of a beam" in assert_problem(refused, 409, "conflict")["detail"]
    other = scene_id(client, "another strip")
    elsewhere = client.post("/v1/traces", json={"scene_id": other, "fit_id": fit_id})
    assert elsewhere.status_code == 202, "a fit of another recording of the object will do"
    client.post(f"/v1/jobs/{elsewhere.json()['id']}/cancel")
    headers = {"Idempotency-Key": "trace-once"}
    body = {"scene_id": scene, "fit_id": fit_id}
    first, again = (client.post("/v1/traces", json=body, headers=headers) for _ in range(2))
    assert first.content == again.content and again.headers["Idempotent-Replayed"] == "true"
    job = first.json()
    assert {item["kind"] for item in job["inputs"]} == {"scene", "fit"}
    assert client.post(f"/v1/jobs/{job['id']}/cancel").json()["state"] == "cancelled"
    assert client.get(job["links"]["trace"]).json()["state"] == "cancelled"
    assert_problem(client.get("/v1/traces/trc_none"), 404, "not_found")


def test_unknown_candidates_are_named(client: httpx.Client) -> None:
    config = {"candidates": ["air_drag_linear", "phlogiston"]}
    scene = scene_id(client)
    problem = assert_problem(
        client.post("/v1/traces", json={"scene_id": scene, "config": config}), 422, "invalid_request"
    )
    assert problem["errors"][0]["loc"] == ["body", "config", "candidates", 1]
    assert "phlogiston" in problem["detail"]
    body = {"scene_id": scene, "close_the_loop": True, "trace": config}
    assert_problem(client.post("/v1/pipelines", json=body), 422, "invalid_request")


def test_a_named_effect_is_compared_with_a_model_without_it(client: httpx.Client, service: Service) -> None:
    job = pipeline(client, "closed loop", close_the_loop=True)
    service.work()
    assert kinds(client, job["id"]) == ["fit", "trace", "dataset", "training", "dataset", "training"]
    versions = client.get("/v1/models/closed-loop/versions").json()["data"]
    assert [(version["version"], version["trace_id"] is not None) for version in versions] == [
        (2, True),
        (1, False),
    ]
    dataset = client.get(f"/v1/datasets/{versions[0]['dataset_id']}").json()
    assert dataset["trace_id"] == versions[0]["trace_id"]
    assert {item["kind"] for item in dataset["lineage"]["inputs"]} >= {"fit", "trace"}


@pytest.mark.parametrize(
    ("name", "verdict", "compare"), [("not named", "equivalent_set", True), ("alone", "named", False)]
)
def test_without_a_name_or_a_comparison_one_model_is_made(
    client: httpx.Client, service: Service, name: str, verdict: str, compare: bool
) -> None:
    service.verdict = verdict
    job = pipeline(client, name, close_the_loop=True, compare=compare)
    service.work()
    assert kinds(client, job["id"]) == ["fit", "trace", "dataset", "training"]
    (version,) = client.get(f"/v1/models/{name.replace(' ', '-')}/versions").json()["data"]
    trace = client.get(f"/v1/traces/{version['trace_id']}").json()
    assert trace["verdict"] == verdict
    assert any(item["name"] == "twin.npz" for item in trace["artifacts"]) is (verdict == "named")


def test_progress_of_a_closed_loop_only_grows(client: httpx.Client, service: Service) -> None:
    job = pipeline(client, "grows", close_the_loop=True)
    seen = [0.0]
    while service.work(1):
        seen.append(client.get(f"/v1/jobs/{job['id']}").json()["progress"]["done"])
    assert seen == sorted(seen) and seen[-1] == 100.0


@pytest.fixture(scope="module")
def model(service: Service) -> str:
    """A published version."""
    with service.client() as client:
        pipeline(client, "assessed")
        service.work()
    return "/v1/models/assessed/versions/1"


@pytest.mark.parametrize(
    ("outcome", "asked", "traced"),
    [
        ("within_noise", True, False),
        ("as_expected", True, False),
        ("worse_than_expected", True, True),
        ("worse_than_expected", False, False),
    ],
)
def test_an_assessment_opens_a_trace_where_the_model_has_become_worse(
    client: httpx.Client, service: Service, model: str, outcome: str, asked: bool, traced: bool
) -> None:
    service.outcome = outcome
    scene = scene_id(client, "a new recording")
    body = {"scene_id": scene, "open_trace": asked, "trace": {"iterations": 3}}
    job, assessment_id = made(client, f"{model}/assessments", body, "assessment")
    assert client.get(job["links"]["assessment"]).json()["outcome"] is None
    service.work(1)
    answer = client.get(f"/v1/assessments/{assessment_id}").json()
    assert (answer["state"], answer["outcome"], answer["scene_id"]) == ("ready", outcome, scene)
    assert answer["expected"]["ci95_m"] == [1e-3, 3e-3]
    assert (answer["trace_id"] is not None) is traced is ("trace" in answer["links"])
    if traced:
        trace = client.get(answer["links"]["trace"]).json()
        assert (trace["scene_id"], trace["config"]["iterations"]) == (scene, 3)
        assert trace["fit"] == TraceCreate(scene_id=scene).fit.model_dump(mode="json")
        done = client.get(f"/v1/jobs/{job['id']}").json()
        assert done["links"]["trace"] == answer["links"]["trace"]
        service.work()
        assert client.get(answer["links"]["trace"]).json()["verdict"] == "named"
    name = model.split("/")[3]
    for path in (f"{model}/assessments", "/v1/assessments", f"/v1/assessments?model={name}"):
        listed = client.get(path).json()["data"]
        assert listed[0] == client.get(f"/v1/assessments/{assessment_id}").json()
    assert client.get("/v1/assessments?model=nobody").json()["data"] == []


def test_assessments_need_a_ready_version(client: httpx.Client, service: Service, model: str) -> None:
    scene = scene_id(client)
    dataset = client.get(model).json()["dataset_id"]
    job = client.post("/v1/models", json={"name": "assessed", "dataset_id": dataset}).json()
    pending = job["links"]["model"]
    assert_problem(client.post(f"{pending}/assessments", json={"scene_id": scene}), 409, "conflict")
    client.post(f"/v1/jobs/{job['id']}/cancel")
    assert_problem(client.post(f"{model}/assessments", json={"scene_id": "scn_none"}), 404, "not_found")
    nowhere = "/v1/models/nobody/versions/latest/assessments"
    assert_problem(client.post(nowhere, json={"scene_id": scene}), 404, "not_found")
    assert_problem(client.get("/v1/assessments/ass_none"), 404, "not_found")
