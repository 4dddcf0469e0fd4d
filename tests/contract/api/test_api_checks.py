"""Checks over HTTP: asked, listed, answered, refused and deleted."""

from __future__ import annotations

import httpx
from api_service import Service, assert_problem, scene_id
from checked import REPORT


def asked(client: httpx.Client, scene: str, **config: object) -> tuple[dict[str, object], str]:
    """A job and the id of the check that it will make."""
    response = client.post("/v1/checks", json={"scene_id": scene, "config": config})
    assert response.status_code == 202, response.text
    job = response.json()
    (made,) = job["outputs"]
    assert made["kind"] == "check" and made["id"].startswith("chk_")
    return job, made["id"]


def test_a_check_is_accepted_and_answers_with_its_report(client: httpx.Client, service: Service) -> None:
    scene = scene_id(client)
    job, check_id = asked(client, scene, candidates=["air_drag_linear"], discrepancy_share=0.05)
    assert job["links"]["check"] == f"/v1/checks/{check_id}"  # type: ignore[index]
    pending = client.get(f"/v1/checks/{check_id}").json()
    assert (pending["state"], pending["report"]) == ("pending", None)
    assert service.work() == 1
    check = client.get(f"/v1/checks/{check_id}").json()
    assert (check["state"], check["scene_id"], check["report"]) == ("ready", scene, REPORT)
    assert check["config"]["discrepancy_share"] == 0.05
    listed = client.get("/v1/checks", params={"scene_id": scene, "state": "ready"}).json()["data"]
    assert [item["id"] for item in listed] == [check_id]
    assert client.get("/v1/checks", params={"scene_id": "scn_none"}).json()["data"] == []
    ended = client.get(f"/v1/jobs/{job['id']}").json()
    assert ended["state"] == "succeeded"


def test_what_a_check_cannot_be_asked_is_refused(client: httpx.Client) -> None:
    scene = scene_id(client)
    body = {"scene_id": scene, "config": {"candidates": ["phlogiston"]}}
    assert_problem(client.post("/v1/checks", json=body), 422, "invalid_request")
    for config in ({"discrepancy_share": 1.0}, {"noise_m": 0.0}, {"particle_budget": 1}, {"unknown": 1}):
        refused = client.post("/v1/checks", json={"scene_id": scene, "config": config})
        assert refused.status_code == 422, config
    assert_problem(client.post("/v1/checks", json={"scene_id": "scn_none"}), 404, "not_found")
    assert_problem(client.get("/v1/checks/chk_none"), 404, "not_found")


def test_a_scene_goes_only_after_its_checks(client: httpx.Client, service: Service) -> None:
    scene = scene_id(client, "checked strip")
    _, check_id = asked(client, scene)
    assert_problem(client.delete(f"/v1/checks/{check_id}"), 409, "conflict")  # its job runs
    service.work()
    assert_problem(client.delete(f"/v1/scenes/{scene}"), 409, "conflict")
    assert client.delete(f"/v1/checks/{check_id}").status_code == 204
    assert client.delete(f"/v1/scenes/{scene}").status_code == 204
