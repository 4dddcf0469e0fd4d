"""Addresses, retries, errors and events: what both clients share."""

from __future__ import annotations

import inspect
import json
import random
import re
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from pathlib import Path

import httpx
import pytest
from physworld_client import (
    AsyncClient,
    Client,
    artifacts,
    async_artifacts,
    async_live,
    async_loop,
    async_predict,
    async_resources,
    errors,
    live,
    loop,
    predict,
    resources,
)
from physworld_client.errors import PhysWorldError, SceneInvalid, error_from_response
from physworld_client.stream import EventDecoder, ends_job
from physworld_client.transport import (
    RETRIED_STATUSES,
    RETRY_LIMIT_S,
    Retry,
    client_options,
    is_loopback,
    retry_after_s,
)


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("http://127.0.0.1:8000", True),
        ("http://127.9.9.9", True),
        ("http://localhost:1", True),
        ("http://[::1]:80", True),
        ("http://physworld.localhost", True),
        ("http://128.0.0.1", False),
        ("https://example.org", False),
        ("http://localhost.example.org", False),
    ],
)
def test_proxies_of_the_environment_never_capture_this_machine(url: str, expected: bool) -> None:
    assert is_loopback(url) is expected
    assert client_options(url, None, 1.0)["trust_env"] is not expected


@pytest.mark.parametrize("url", ["127.0.0.1:8000", "ftp://host", ""])
def test_what_is_no_http_address_is_refused(url: str) -> None:
    with pytest.raises(PhysWorldError, match="not an http address"):
        Client(url)


def test_delays_grow_with_jitter_up_to_a_limit() -> None:
    retry = Retry(max_retries=20, random=random.Random(1))
    delays = []
    while retry.again():
        delays.append(retry.delay_s())
    assert len(delays) == 20
    assert max(delays) <= RETRY_LIMIT_S
    assert len(set(delays)) == 20
    assert delays[0] < delays[3] < delays[5]


def test_the_documentation_names_the_statuses_that_are_tried_again(repository: Path) -> None:
    text = (repository / "docs" / "sdk.md").read_text()
    (sentence,) = re.findall(r"Connection errors, timeouts and ([^.(]*) are tried again", text)
    assert {int(status) for status in re.findall(r"\d+", sentence)} == RETRIED_STATUSES
    assert "5xx" not in sentence and 507 not in RETRIED_STATUSES


def test_retry_after_is_honoured_within_reason() -> None:
    retry = Retry(max_retries=1)
    assert retry.again()
    assert retry.delay_s(httpx.Response(503, headers={"Retry-After": "7"})) == 7.0
    assert retry.delay_s(httpx.Response(503, headers={"Retry-After": "86400"})) <= RETRY_LIMIT_S
    assert not retry.again()


def test_retry_after_is_a_number_or_a_date() -> None:
    soon = format_datetime(datetime.now(UTC) + timedelta(seconds=100))
    seconds = retry_after_s(soon)
    assert seconds is not None and 90.0 < seconds <= 100.0
    assert retry_after_s("2.5") == 2.5
    assert retry_after_s(format_datetime(datetime.now(UTC) - timedelta(hours=1))) == 0.0
    assert retry_after_s("soon") is None
    assert retry_after_s(None) is None


def test_a_problem_becomes_the_error_of_its_status_and_code() -> None:
    problem = {
        "title": "Unprocessable Entity",
        "status": 422,
        "code": "scene_invalid",
        "detail": "the scene has 1 fault",
        "request_id": "req_1",
        "errors": [{"loc": ["points", 3], "msg": "frame 3 holds 12 NaN"}],
        "hint": "mark them as not visible",
    }
    error = error_from_response(422, "application/problem+json", json.dumps(problem).encode())
    assert isinstance(error, SceneInvalid)
    assert str(error) == (
        "the scene has 1 fault; points.3: frame 3 holds 12 NaN (mark them as not visible) "
        "[scene_invalid, req_1]"
    )


@pytest.mark.parametrize(
    ("status", "kind"),
    [
        (400, errors.BadRequest),
        (401, errors.AuthenticationFailed),
        (403, errors.PermissionDenied),
        (404, errors.NotFound),
        (409, errors.Conflict),
        (413, errors.PayloadTooLarge),
        (418, errors.ApiError),
        (422, errors.InvalidRequest),
        (429, errors.RateLimited),
        (502, errors.ServerError),
        (599, errors.ServerError),
    ],
)
@pytest.mark.parametrize("content_type", ["text/html", "application/json"])
def test_a_page_of_a_proxy_is_an_error_too(status: int, kind: type, content_type: str) -> None:
    error = error_from_response(status, content_type, b"<html>no\n way</html>")
    assert type(error) is kind
    assert error.code == f"http_{status}"
    assert "<html>no way</html>" in str(error)


def test_every_error_stands_in_the_tree_and_is_exported() -> None:
    import physworld_client

    for name, value in vars(errors).items():
        if inspect.isclass(value) and issubclass(value, PhysWorldError):
            assert name in (errors.__doc__ or "")
            assert getattr(physworld_client, name) is value


def event_lines(seq: int, type: str = "progress", **data: object) -> list[str]:
    event = {"seq": seq, "job_id": "job_1", "type": type, "at": "2026-01-01T00:00:00Z", "data": data}
    return [f"id: {seq}", f"event: {type}", f"data: {json.dumps(event)}", ""]


def test_events_are_decoded_and_their_ids_remembered() -> None:
    decoder = EventDecoder()
    assert "Last-Event-ID" not in decoder.headers()
    lines = [": heartbeat", "", *event_lines(4, done=1), *event_lines(7, "state", state="succeeded")]
    events = [event for line in lines if (event := decoder.feed(line))]
    assert [event.seq for event in events] == [4, 7]
    assert decoder.headers()["Last-Event-ID"] == "7"
    assert [ends_job(event, "job_1") for event in events] == [False, True]
    assert not ends_job(events[1], "job_2")


def test_an_event_cut_in_the_middle_is_forgotten_at_the_reconnection() -> None:
    decoder = EventDecoder()
    for line in event_lines(4)[:3]:
        assert decoder.feed(line) is None
    decoder.reset()
    assert decoder.feed("") is None
    assert decoder.last_id is None


def test_the_asynchronous_resources_have_the_same_names_and_arguments() -> None:
    def public(module: object) -> dict[str, dict[str, list[str]]]:
        found = {}
        for name, value in vars(module).items():
            if inspect.isclass(value) and value.__module__ == getattr(module, "__name__", ""):
                methods = {
                    method: list(inspect.signature(function).parameters)
                    for method, function in vars(value).items()
                    if inspect.isfunction(function)
                }
                found[name.removeprefix("Async")] = methods
        return found

    def called(found: dict[str, dict[str, list[str]]]) -> dict[str, dict[str, list[str]]]:
        """Without what only one of the two languages of waiting has: ``__iter__``, ``__aiter__``."""
        return {
            name: {method: given for method, given in methods.items() if method[0] != "_"}
            for name, methods in found.items()
        }

    assert public(resources) == public(async_resources)
    assert public(artifacts) == public(async_artifacts)
    assert public(loop) == public(async_loop)
    assert public(predict) == public(async_predict)
    assert called(public(live)) == called(public(async_live))
    assert list(inspect.signature(Client).parameters) == list(inspect.signature(AsyncClient).parameters)


def test_the_synchronous_half_is_made_of_the_asynchronous_one(repository: Path) -> None:
    script = [sys.executable, str(repository / "scripts" / "make_sdk.py"), "--check"]
    checked = subprocess.run(script, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr + checked.stdout
