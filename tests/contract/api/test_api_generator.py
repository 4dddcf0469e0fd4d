"""What the generator of requests asks a service for (CONTRIBUTING.md) is there, and its bodies are accepted."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest
from api_service import Service, scene_id
from schemathesis_real import Real

MODEL = "asked"


@pytest.fixture(scope="module")
def real(service: Service) -> Iterator[Real]:
    """A service with two versions of one model, and another model that has none yet."""
    with service.client() as client:
        scene = scene_id(client, MODEL)
        body = {"scene_id": scene, "model_name": MODEL, "dataset": {"episodes": 1}, "training": {"steps": 5}}
        assert client.post("/v1/pipelines", json=body).status_code == 202
        service.work()
        dataset = client.get("/v1/datasets").json()["data"][0]["id"]
        training = {"dataset_id": dataset, "config": {"steps": 6}}
        assert client.post("/v1/models", json={"name": MODEL, **training}).status_code == 202
        service.work()
        assert client.post("/v1/models", json={"name": "untrained", **training}).status_code == 202
    real = Real(service.url, service.token("admin"))
    yield real
    real.close()


@pytest.mark.parametrize("path", ["/v1/plans", "/v1/loops"])
def test_bodies_that_fit_a_model_are_accepted(client: httpx.Client, real: Real, path: str) -> None:
    body = real.plan() if path == "/v1/plans" else real.loop()
    answer = client.post(path, json=body)
    assert answer.status_code == 202, answer.text


def test_a_loop_is_made_where_there_is_none(client: httpx.Client, real: Real) -> None:
    for loop in client.get("/v1/loops").json()["data"]:
        assert client.post(f"/v1/jobs/{loop['id']}/cancel").status_code in (200, 202, 409)
    answer = client.get(f"/v1/loops/{real.looped()}")
    assert answer.status_code == 200, answer.text


def test_versions_are_compared_that_are_ready(client: httpx.Client, real: Real) -> None:
    pairs = set()
    for _ in range(20):
        name, query = real.compared()
        answer = client.get(f"/v1/models/{name}/compare", params=query)
        assert answer.status_code == 200, answer.text
        pairs.add((query["a"], query["b"]))
    assert len({a for a, _ in pairs}) == 2


def test_what_is_deleted_is_made_for_it(client: httpx.Client, real: Real) -> None:
    for (method, path), ending in real.ends.items():
        parameters = ending()
        if method == "DELETE" and "rollout" not in path:  # which asks the inference service
            assert parameters is not None, path
            answer = client.delete(path.format(**parameters))
            assert answer.status_code in (200, 204), (path, answer.text)
