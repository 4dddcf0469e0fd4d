"""Films and pictures over HTTP: asked, listed, kept, replaced, refused and deleted."""

from __future__ import annotations

import io
import json

import httpx
import numpy as np
from api_service import Service, assert_problem, scene_id
from conftest import MAX_UPLOAD_BYTES

from physworld_storage.jobs import leases

CAMERA = {
    "width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0,
    "world_to_camera": np.eye(4).tolist(),
}  # fmt: skip
REPORT = {
    "frames": 20, "fps": 30.0, "drawn": "points", "gaussians": 9, "seen_from": "whole", "camera": CAMERA,
    "scores": None, "not_scored": "the scene has no pictures", "seconds": 1.0,
}  # fmt: skip


def keep(client: httpx.Client, scene: str, name: str, content: bytes) -> httpx.Response:
    return client.post(f"/v1/scenes/{scene}/pictures/{name}", files={"bundle": (name, content)})


def finish(service: Service, film: bytes = b"film") -> None:
    lease = service.claim()
    assert lease is not None and lease.kind == "video"
    made = service.stores.artifacts.put_bytes(film, "film.mp4", "video/mp4")
    result = {"report": REPORT, "artifacts": [made.model_dump()]}
    with service.database.session() as session:
        assert leases.complete(session, lease, result, made.sha256)


def test_a_film_is_accepted_and_answers_with_its_report(client: httpx.Client, service: Service) -> None:
    scene = scene_id(client, "filmed strip")
    response = client.post("/v1/videos", json={"of": "scene", "id": scene, "config": {"azimuth_deg": 45.0}})
    assert response.status_code == 202, response.text
    job = response.json()
    (made,) = job["outputs"]
    assert made["kind"] == "video" and job["links"]["video"] == f"/v1/videos/{made['id']}"
    pending = client.get(f"/v1/videos/{made['id']}").json()
    assert (pending["state"], pending["report"], pending["artifacts"]) == ("pending", None, [])
    assert_problem(client.delete(f"/v1/videos/{made['id']}"), 409, "conflict")  # its job runs
    finish(service)
    film = client.get(f"/v1/videos/{made['id']}").json()
    assert (film["state"], film["of"], film["source_id"], film["scene_id"]) == (
        "ready",
        "scene",
        scene,
        scene,
    )
    assert film["config"]["azimuth_deg"] == 45.0 and film["report"]["frames"] == 20
    assert client.get(f"/v1/artifacts/{film['artifacts'][0]['sha256']}").content == b"film"
    for query, found in (
        ({"scene_id": scene}, 1), ({"of": "scene", "source_id": scene}, 1), ({"of": "fit", "scene_id": scene}, 0)
    ):  # fmt: skip
        assert len(client.get("/v1/videos", params=query).json()["data"]) == found, query
    assert client.get(f"/v1/jobs/{job['id']}").json()["state"] == "succeeded"
    assert_problem(client.delete(f"/v1/scenes/{scene}"), 409, "conflict")  # a film shows it
    assert client.delete(f"/v1/videos/{made['id']}").status_code == 204
    assert client.delete(f"/v1/scenes/{scene}").status_code == 204


def test_what_cannot_be_filmed_is_refused(client: httpx.Client) -> None:
    scene = scene_id(client)
    for of, name in (
        ("scene", "scn_none"),
        ("fit", "fit_none"),
        ("rollout", "rol_none"),
        ("model", "none:1"),
    ):
        assert_problem(client.post("/v1/videos", json={"of": of, "id": name}), 404, "not_found")
    for config in (
        {"width": 8}, {"height": 4000}, {"elevation_deg": 90.0}, {"look": "wire"}, {"candidate": -1},
        {"camera": {**CAMERA, "fx": 0.0}}, {"camera": {**CAMERA, "world_to_camera": [[1.0]]}}, {"unknown": 1},
    ):  # fmt: skip
        refused = client.post("/v1/videos", json={"of": "scene", "id": scene, "config": config})
        assert refused.status_code == 422, config
    assert client.post("/v1/videos", json={"of": "dataset", "id": scene}).status_code == 422
    fit = client.post("/v1/fits", json={"scene_id": scene}).json()["outputs"][0]["id"]
    problem = assert_problem(client.post("/v1/videos", json={"of": "fit", "id": fit}), 409, "conflict")
    assert f"fit {fit} is pending" in problem["detail"]


def test_pictures_stand_beside_the_scene_and_are_replaced_by_name(client: httpx.Client) -> None:
    scene = scene_id(client, "pictured strip")
    before = client.get(f"/v1/scenes/{scene}").json()
    buffer = io.BytesIO()
    np.savez(buffer, frames=np.zeros((20, 48, 64, 3), np.uint8))
    for name, content in (
        ("splat.ply", b"ply\nfirst"), ("camera.json", json.dumps(CAMERA).encode()),
        ("frames.npz", buffer.getvalue()), ("splat.ply", b"ply\nsecond"),
    ):  # fmt: skip
        kept = keep(client, scene, name, content)
        assert kept.status_code == 200, kept.text
    after = client.get(f"/v1/scenes/{scene}").json()
    files = {item["name"]: item["sha256"] for item in after["artifacts"]}
    assert len(after["artifacts"]) == 4 and sorted(files) == [
        "camera.json",
        "frames.npz",
        "scene.zip",
        "splat.ply",
    ]
    assert client.get(f"/v1/artifacts/{files['splat.ply']}").content == b"ply\nsecond"
    assert after["digest"] == before["digest"]


def test_what_is_no_picture_is_refused_and_nothing_is_kept(client: httpx.Client, service: Service) -> None:
    scene = scene_id(client, "bare strip")
    for name, content, said in (
        ("splat.ply", b"<html>", "is a splat in PLY"), ("frames.npz", b"\x93NUMPY", "is an npz of pictures"),
        ("camera.json", b"{", "no camera"), ("camera.json", b"{}", "no camera"),
        ("camera.json", b" " * 20_000, "more than 16384 bytes"),
    ):  # fmt: skip
        problem = assert_problem(keep(client, scene, name, content), 422, "invalid_request")
        assert said in problem["detail"], problem
    assert keep(client, scene, "movie.mp4", b"0").status_code == 422
    assert_problem(keep(client, "scn_none", "splat.ply", b"ply"), 404, "not_found")
    large = b"ply" + b"\0" * (MAX_UPLOAD_BYTES + 1)
    assert_problem(keep(client, scene, "splat.ply", large), 413, "content_too_large")
    address = f"/v1/scenes/{scene}/pictures/splat.ply"
    more = client.post(address, files={"bundle": ("a", b"ply")}, data={"name": "x"})
    assert_problem(more, 422, "invalid_request")
    assert_problem(client.post(address, json={}), 415, "unsupported_media_type")
    with service.client("read") as reader:
        assert_problem(keep(reader, scene, "splat.ply", b"ply"), 403, "forbidden")
    assert [item["name"] for item in client.get(f"/v1/scenes/{scene}").json()["artifacts"]] == ["scene.zip"]
