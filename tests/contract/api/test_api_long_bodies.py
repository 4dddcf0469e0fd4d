"""Long JSON bodies: how many values they may list, and that neither they nor base64 keep the event loop waiting."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable

import httpx
import numpy as np
import pytest
from api_service import assert_problem
from fastapi import APIRouter, FastAPI
from pydantic import BaseModel

from physworld_schemas.arrays import MAX_LISTED_VALUES, EncodedArray
from physworld_schemas.plan import PlanCreate
from physworld_schemas.rollout import MAX_REQUEST_BYTES, RolloutCreate
from physworld_services.api.bodies import LongBodyRoute

CHECKED_WITHIN_S = 0.05
"""Of processor time, for 32 MiB of base64: 1.5 ms here; 220 ms when an expression searched the text."""


class Body(BaseModel):
    values: list[float]


@pytest.mark.parametrize("path", ["/v1/rollouts", "/v1/plans", "/v1/fits"])
def test_a_body_that_lists_too_many_values_is_refused_with_the_limit(client: httpx.Client, path: str) -> None:
    body = {"model": "beam", "controllers": [0] * (MAX_LISTED_VALUES + 2)}
    problem = assert_problem(client.post(path, json=body), 413, "content_too_large")
    assert f"the limit is {MAX_LISTED_VALUES}" in problem["detail"] and "base64" in problem["hint"]


def test_base64_of_any_allowed_length_is_no_list(client: httpx.Client) -> None:
    values = EncodedArray.of(np.zeros((100, 100, 60, 3))).model_dump()
    answer = client.post("/v1/rollouts", json={"model": "absent", "controllers": values})
    assert_problem(answer, 404, "not_found")


def test_the_largest_goal_of_points_fits() -> None:
    goal = {"kind": "points", "index": list(range(10_000)), "places": [[0.5, 0.5, 0.5]] * 10_000}
    body = {"model": "beam", "goal": goal}
    assert len(PlanCreate.model_validate(body).model_dump_json().split(",")) - 1 <= MAX_LISTED_VALUES


def test_long_base64_is_checked_at_once() -> None:
    raw = EncodedArray.of(np.zeros(MAX_REQUEST_BYTES * 3 // 16, dtype=np.float32)).model_dump()
    assert (
        _least_s(lambda: RolloutCreate.model_validate({"model": "m", "controllers": raw})) < CHECKED_WITHIN_S
    )


def test_a_long_body_is_parsed_in_another_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    router = APIRouter(route_class=LongBodyRoute)
    loops: list[int] = []
    parsed: list[int] = []

    async def loop() -> None:
        loops.append(threading.get_ident())

    @router.post("/sum")
    async def total(body: Body) -> float:
        await loop()
        return sum(body.values)

    app = FastAPI()
    app.include_router(router)
    plain = json.loads

    def spied(data: bytes) -> object:
        parsed.append(threading.get_ident())
        return plain(data)

    async def ask(data: bytes) -> httpx.Response:
        transport = httpx.ASGITransport(app=app)
        async with httpx.AsyncClient(transport=transport, base_url="http://test") as client:
            return await client.post("/sum", content=data, headers={"Content-Type": "application/json"})

    with monkeypatch.context() as patch:
        patch.setattr("physworld_services.api.bodies.json.loads", spied)
        answer = asyncio.run(ask(b'{"values": [1, 2, 3.5]}'))
        wrong = asyncio.run(ask(b'{"values": [1, 2'))
    assert (answer.status_code, answer.text) == (200, "6.5")
    assert wrong.status_code == 422
    assert len(parsed) == 2 and not set(parsed) & set(loops)


def _least_s(work: Callable[[], object]) -> float:
    """The least processor time of three runs."""
    found = []
    for _ in range(3):
        started = time.process_time()
        work()
        found.append(time.process_time() - started)
    return min(found)
