"""Keys and roles: who may do what, and what a stranger learns."""

from __future__ import annotations

import re
from pathlib import Path

import httpx
import pytest
from api_service import Service, assert_problem

from physworld_services.api.security import required_role
from physworld_services.web import create_app
from physworld_storage.settings import Settings


@pytest.mark.parametrize(
    "header", [None, "", "Bearer", "Bearer wrong", "Basic dTpw", "Bearer é", "bearer  x y"]
)
def test_strangers_get_401_with_a_challenge(service: Service, header: str | None) -> None:
    with service.client(None) as client:
        headers = {} if header is None else {"Authorization": header.encode()}
        response = client.get("/v1/jobs", headers=headers)  # type: ignore[arg-type]
        assert_problem(response, 401, "unauthenticated")
        assert response.headers["WWW-Authenticate"].startswith("Bearer")


def test_unknown_addresses_below_v1_are_hidden_from_strangers(service: Service) -> None:
    with service.client(None) as client:
        for path in ("/v1/nothing", "/v1", "/v1/"):
            assert_problem(client.get(path), 401, "unauthenticated")


def test_the_security_policy_names_all_that_needs_no_key(service: Service, tmp_path: Path) -> None:
    text = (Path(__file__).resolve().parents[3] / "SECURITY.md").read_text()
    named = set(re.findall(r"`(/[^`]*)`", text.partition("## What counts")[2].partition("None of them")[0]))
    app = create_app(Settings(data_dir=tmp_path))
    served = {*app.openapi()["paths"], *(getattr(one, "path", "") for one in app.routes), *named, "/metrics"}
    with service.client(None) as stranger:
        plain = {path for path in served if path.startswith("/") and "{" not in path}
        opened = {path for path in plain if stranger.get(path).status_code < 400}
        assert stranger.get("/dashboard/scenes").status_code == 401
    assert {"/health/ready", "/metrics", "/openapi.json", "/docs", "/dashboard/login"} <= opened
    unnamed = {path for path in opened if not any(f"{path}/".startswith(f"{one}/") for one in named - {"/"})}
    assert unnamed == {"/", "/dashboard"}, "they lead to the login page"


def test_a_body_is_not_read_before_the_key(service: Service) -> None:
    with service.client(None) as client:
        assert_problem(client.post("/v1/fits", content=b"{broken"), 401, "unauthenticated")


@pytest.mark.parametrize(
    ("method", "path", "role"),
    [
        ("GET", "/v1/jobs", "read"),
        ("HEAD", "/v1/artifacts/x", "read"),
        ("POST", "/v1/fits", "write"),
        ("PUT", "/v1/models/m/aliases/a", "write"),
        ("DELETE", "/v1/models/m/aliases/a", "write"),
        ("GET", "/v1/keys", "admin"),
        ("POST", "/v1/keys", "admin"),
        ("GET", "/v1/keysmith", "read"),
    ],
)
def test_role_that_a_request_needs(method: str, path: str, role: str) -> None:
    assert required_role(method, path, "/v1") == role


def test_roles_are_enforced(service: Service) -> None:
    with service.client("read") as reader, service.client("write") as writer:
        assert reader.get("/v1/jobs").status_code == 200
        refused = assert_problem(reader.post("/v1/fits", json={"scene_id": "x"}), 403, "forbidden")
        assert "write" in refused["detail"] and "read" in refused["detail"]
        assert_problem(writer.post("/v1/fits", json={"scene_id": "scn_none"}), 404, "not_found")
        assert_problem(writer.get("/v1/keys"), 403, "forbidden")


def test_key_is_made_used_and_revoked(client: httpx.Client, service: Service) -> None:
    made = client.post("/v1/keys", json={"name": "robot", "role": "write"})
    assert made.status_code == 201
    key = made.json()
    assert made.headers["Location"] == f"/v1/keys/{key['id']}"
    headers = {"Authorization": f"Bearer {key['token']}"}
    with service.client(None) as robot:
        assert robot.get("/v1/jobs", headers=headers).status_code == 200
        assert key["id"] in {item["id"] for item in client.get("/v1/keys").json()["data"]}
        assert all(item["token"] is None for item in client.get("/v1/keys").json()["data"])
        revoked = client.delete(f"/v1/keys/{key['id']}")
        assert revoked.json()["revoked_at"]
        assert_problem(robot.get("/v1/jobs", headers=headers), 401, "unauthenticated")
    assert_problem(client.delete("/v1/keys/key_none"), 404, "not_found")


def test_a_token_is_never_stored(client: httpx.Client, service: Service) -> None:
    headers = {"Idempotency-Key": "make-a-key"}
    first = client.post("/v1/keys", json={"name": "once"}, headers=headers).json()
    replay = client.post("/v1/keys", json={"name": "once"}, headers=headers)
    assert replay.headers["Idempotent-Replayed"] == "true"
    assert replay.json() == {**first, "token": None}
    for file in service.settings.data_dir.rglob("*"):
        assert not file.is_file() or first["token"].encode() not in file.read_bytes(), file


def test_health_and_metrics_need_no_key(service: Service) -> None:
    with service.client(None) as client:
        for path in ("/health/live", "/health/ready", "/metrics", "/docs", "/openapi.json"):
            assert client.get(path).status_code == 200, path
        assert client.get("/redoc").status_code == 404
