"""Problems in one form, request ids, metrics, readiness, logs."""

from __future__ import annotations

import io
import json
import logging
import shutil
from pathlib import Path

import httpx
import pytest
import structlog
from api_service import Service, ask, assert_problem, scene_id

from physworld_schemas.base import FieldError
from physworld_services.api.errors import problem_response
from physworld_services.api.logs import configure_logs
from physworld_services.web import create_app
from physworld_storage.database import open_database
from physworld_storage.settings import Settings


def test_the_framework_answers_in_the_same_form(client: httpx.Client) -> None:
    assert_problem(client.get("/v1/nothing"), 404, "not_found")
    assert_problem(client.get("/nothing"), 404, "not_found")
    refused = client.patch("/v1/jobs")
    assert_problem(refused, 405, "method_not_allowed")
    assert "GET" in refused.headers["Allow"]
    assert_problem(
        client.post("/v1/fits", content=b"{", headers={"Content-Type": "application/json"}),
        422,
        "invalid_request",
    )


def test_a_problem_can_be_sent_whatever_text_it_quotes() -> None:
    fault = FieldError(loc=["caf\udce9"], msg="\ud800")
    problem = json.loads(problem_response(422, "x", "caf\udce9 é", request_id=None, errors=[fault]).body)
    assert problem["detail"] == "caf\\udce9 é"
    assert problem["errors"] == [{"loc": ["caf\\udce9"], "msg": "\\ud800"}]


def test_every_field_at_fault_is_named(client: httpx.Client) -> None:
    body = {"scene_id": 5, "config": {"max_simulations": 0, "sead": 1}}
    problem = assert_problem(client.post("/v1/fits", json=body), 422, "invalid_request")
    assert {tuple(fault["loc"]) for fault in problem["errors"]} == {
        ("body", "scene_id"),
        ("body", "config", "max_simulations"),
        ("body", "config", "sead"),
    }
    assert "scene_id" in problem["detail"]


@pytest.mark.parametrize("depth", [50, 600, 900, 20_000])
def test_a_body_nested_deep_is_refused(client: httpx.Client, depth: int) -> None:
    text = '{"scene_id": "scn_a", "config": ' + "[" * depth + "]" * depth + "}"
    answer = client.post("/v1/fits", content=text, headers={"Content-Type": "application/json"})
    assert answer.status_code in {400, 422} and answer.json()["code"] in {"bad_request", "invalid_request"}


def test_a_large_body_is_refused_with_both_numbers(client: httpx.Client) -> None:
    body = {"scene_id": "x" * 2_000_000}
    problem = assert_problem(client.post("/v1/fits", json=body), 413, "content_too_large")
    assert "1048576" in problem["detail"]


def test_values_that_no_database_keeps_are_refused(client: httpx.Client) -> None:
    scene = scene_id(client)
    for seed in (-1, 2**63, 0.5):
        body = {"scene_id": scene, "dataset": {"seed": seed}}
        assert_problem(client.post("/v1/pipelines", json=body), 422, "invalid_request")
    for text in ("\0", "a\0b", "\ud800"):
        data = json.dumps({"name": "m", "dataset_id": "dst_none", "description": text})
        headers = {"Content-Type": "application/json"}
        assert_problem(client.post("/v1/models", content=data, headers=headers), 422, "invalid_request")
    assert_problem(client.post("/v1/fits", json={"scene_id": "a\0"}), 422, "invalid_request")


def test_request_id_is_kept_if_it_is_sound(client: httpx.Client) -> None:
    kept = client.get("/v1/jobs", headers={"X-Request-Id": "trace-1.2_3"})
    assert kept.headers["X-Request-Id"] == "trace-1.2_3"
    for bad in ("a b", "x" * 65, "<script>"):
        made = client.get("/v1/jobs", headers={"X-Request-Id": bad}).headers["X-Request-Id"]
        assert made.startswith("req_")


def test_metrics_count_requests_jobs_and_waiting_shards(client: httpx.Client, service: Service) -> None:
    client.post("/v1/fits", json={"scene_id": scene_id(client)})
    client.get("/v1/jobs/job_none")
    text = client.get("/metrics").text
    assert 'physworld_requests_total{method="GET",route="/v1/jobs/{job_id}",status="404"} 1.0' in text
    assert 'physworld_jobs{kind="fit",state="queued"} 1.0' in text
    assert 'physworld_queue_depth{queue="sim"} 1.0' in text
    assert 'physworld_queue_depth{queue="train"} 0.0' in text
    assert "job_none" not in text
    service.work()
    assert 'physworld_queue_depth{queue="sim"} 0.0' in client.get("/metrics").text


def test_an_unexpected_fault_is_a_problem_without_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("secret address")

    settings = Settings(data_dir=tmp_path)
    open_database(settings).upgrade()
    app = create_app(settings)
    monkeypatch.setattr("physworld_storage.database.Database.check", broken)
    response = ask(app, "/health/ready")
    problem = assert_problem(response, 500, "internal_error")
    assert "secret address" not in json.dumps(problem)


def test_not_ready_without_tables_or_store(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    app = create_app(settings)
    assert ask(app, "/health/live").status_code == 200
    refused = ask(app, "/health/ready")
    problem = assert_problem(refused, 503, "database_unavailable")
    assert "revision None" in problem["detail"]
    assert refused.headers["Retry-After"]
    open_database(settings).upgrade()
    assert ask(app, "/health/ready").status_code == 200


def test_a_lost_database_is_503(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    database = open_database(settings)
    database.upgrade()
    database.dispose()
    app = create_app(settings)
    app.state.database.dispose()
    for file in tmp_path.glob("physworld.db*"):
        file.unlink()
    (tmp_path / "physworld.db").mkdir()
    refused = ask(app, "/v1/jobs", {"Authorization": "Bearer " + "x" * 40})
    assert_problem(refused, 503, "database_unavailable")
    shutil.rmtree(tmp_path / "physworld.db")


def test_logs_are_json_lines_with_the_request_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    root = logging.getLogger()
    handlers, level, before = root.handlers[:], root.level, structlog.get_config()
    monkeypatch.setattr("sys.stderr", stream)
    try:
        configure_logs("info")
        settings = Settings(data_dir=tmp_path)
        open_database(settings).upgrade()
        stream.truncate(0)
        stream.seek(0)
        app = create_app(settings)
        ask(app, "/v1/jobs", {"X-Request-Id": "mine"})
        ask(app, "/health/live")
        lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    finally:
        structlog.configure(**before)
        root.handlers[:] = handlers
        root.setLevel(level)
        logging.getLogger("uvicorn.access").disabled = False
    requests = [line for line in lines if line["event"] == "request"]
    assert [(line["path"], line["status"], line["request_id"]) for line in requests] == [
        ("/v1/jobs", 401, "mine")
    ]
    assert requests[0]["level"] == "info"


def test_a_body_that_is_no_text_is_refused_as_the_document_says(client: httpx.Client) -> None:
    headers = {"Content-Type": "application/json"}
    answer = client.post("/v1/fits", content=b"\xff\xfe{", headers=headers)
    assert_problem(answer, 422, "invalid_request")
    assert "UTF-8" in answer.json()["detail"]


def test_allow_names_every_method_of_an_address(client: httpx.Client) -> None:
    for path, methods in (
        ("/v1/scenes", {"GET", "POST"}),
        ("/v1/scenes/preview", {"POST"}),
        ("/v1/fits/fit_x", {"DELETE", "GET"}),
        ("/v1/models/m/versions/1", {"DELETE", "GET", "PATCH"}),
        ("/v1/models/m/aliases/a", {"DELETE", "PUT"}),
    ):
        answer = client.request("TRACE", path)
        assert answer.status_code == 405
        assert set(answer.headers["Allow"].split(", ")) == methods, path
