"""Trackings over HTTP: what cameras show first, a job that ends in a scene, and what is refused at once."""

from __future__ import annotations

import base64
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from api_service import Service, assert_problem, bundle
from conftest import MAX_UPLOAD_BYTES
from PIL import Image
from planar_filmed import Film
from tracking_pictured import BOTTOM, FAR_M, FRAMES, HEIGHT, LEFT, NEAR_M, RIGHT, TOP, WIDTH, write

from physworld_scenes.bundle import bundle_from_bytes
from physworld_scenes.facts import facts_of
from physworld_storage.jobs import leases

OPTIONS: dict[str, Any] = {"kind": "sheet", "boxes": {"0": [42, 32, 118, 88]}, "up": "-y"}


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("pictures") / "plate"
    write(folder)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path in sorted(folder.rglob("*.*")):
            archive.write(path, path.relative_to(folder.parent).as_posix())
    return buffer.getvalue()


def send(
    client: httpx.Client, place: str, data: bytes, name: str = "take.zip", **form: str
) -> httpx.Response:
    return client.post(f"/v1/trackings{place}", files={"bundle": (name, data)}, data=form)


def test_a_preview_shows_the_first_picture_of_each_camera_and_stores_nothing(
    client: httpx.Client, pictures: bytes
) -> None:
    answer = send(client, "/preview", pictures)
    assert answer.status_code == 200, answer.text
    found = answer.json()
    (camera,) = found["cameras"]
    assert (found["form"], camera["camera"], camera["frames"]) == ("rgbd", 0, FRAMES)
    with Image.open(io.BytesIO(base64.b64decode(camera["data"]))) as picture:
        assert picture.size == (WIDTH, HEIGHT) and camera["media_type"] == "image/png"
    assert client.get("/v1/jobs", params={"kind": "tracking"}).json()["data"] == []
    cloud = found["cloud"]
    assert found["unclouded"] is None and cloud["ground_m"] is None and "no ground" in cloud["warnings"][0]
    places, at = np.array(cloud["places_m"]), np.array(cloud["pixels"])
    assert 0 < len(places) <= 5000 and set(cloud["cameras"]) == {0} and len(cloud["colours"]) == len(places)
    plate = (at >= (LEFT, TOP)).all(axis=1) & (at < (RIGHT, BOTTOM)).all(axis=1)
    assert np.allclose(places[plate, 1], NEAR_M) and np.allclose(places[~plate, 1], FAR_M)


def test_a_preview_is_turned_as_its_options_say(client: httpx.Client, pictures: bytes) -> None:
    found = send(client, "/preview", pictures, options=json.dumps({"up": "z", "depth_scale": 2000.0})).json()
    assert found["cloud"]["up"] == "z of the cameras' world, given"
    assert np.isclose(np.array(found["cloud"]["places_m"])[:, 2].max(), FAR_M / 2)


def test_a_film_shows_its_first_frame(client: httpx.Client, tmp_path: Path) -> None:
    film = Film().write(tmp_path / "strip.mp4", frames=3).read_bytes()
    found = send(client, "/preview", film, "strip.mp4").json()
    (camera,) = found["cameras"]
    assert (found["form"], camera["media_type"]) == ("film", "image/jpeg")
    assert found["cloud"] is None and found["unclouded"] is None
    with Image.open(io.BytesIO(base64.b64decode(camera["data"]))) as picture:
        assert picture.size == (480, 360)


def test_a_tracking_is_a_job_whose_output_is_a_scene(
    client: httpx.Client, service: Service, pictures: bytes
) -> None:
    answer = send(client, "", pictures, options=json.dumps(OPTIONS), name_="")
    assert assert_problem(answer, 422, "invalid_request")["errors"][0]["loc"] == ["body", "name_"]
    headers = {"Idempotency-Key": "one-take"}
    sent = [
        client.post(
            "/v1/trackings",
            files={"bundle": ("../take.zip", pictures)},
            data={"options": json.dumps(OPTIONS)},
            headers=headers,
        )
        for _ in range(2)
    ]
    assert [one.status_code for one in sent] == [202, 202], sent[0].text
    assert sent[0].json() == sent[1].json()
    job = sent[0].json()
    assert (job["kind"], job["outputs"], job["config"]["file"]) == ("tracking", [], "take.zip")
    lease = service.claim()
    assert lease is not None and lease.kind == "tracking"
    assert service.stores.artifacts.read_bytes(lease.payload["upload"]) == pictures
    data = bundle("followed")
    scene, warnings = bundle_from_bytes(data)
    made = service.stores.artifacts.put_bytes(data, "scene.zip")
    look = service.stores.artifacts.put_bytes(b"look", "followed.png", "image/png")
    result = {"facts": facts_of(scene, warnings), "artifacts": [made.model_dump(), look.model_dump()]}
    with service.database.session() as session:
        assert leases.complete(session, lease, json.loads(json.dumps(result)), made.sha256)
    job = client.get(f"/v1/jobs/{job['id']}").json()
    (output,) = job["outputs"]
    assert job["state"] == "succeeded" and job["links"]["scene"] == f"/v1/scenes/{output['id']}"
    scene_made = client.get(job["links"]["scene"]).json()
    assert [item["name"] for item in scene_made["artifacts"]] == ["scene.zip", "followed.png"]


def test_what_is_no_archive_or_film_is_refused_at_once(client: httpx.Client, pictures: bytes) -> None:
    for place in ("", "/preview"):
        problem = assert_problem(send(client, place, b"no pictures", "a.txt"), 422, "scene_invalid")
        assert "neither" in problem["errors"][0]["msg"]
    cut = assert_problem(send(client, "/preview", pictures[: len(pictures) // 2]), 422, "scene_invalid")
    assert "damaged or truncated" in cut["errors"][0]["msg"]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("../../color/0.png", b"x")
    climbing = assert_problem(send(client, "/preview", buffer.getvalue()), 422, "scene_invalid")
    assert "climbs out" in climbing["errors"][0]["msg"]
    large = send(client, "", b"PK\x03\x04" + bytes(MAX_UPLOAD_BYTES))
    assert_problem(large, 413, "content_too_large")


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"boxes": {"0": [1, 2, 3]}}, ["boxes", "0", 3]),
        ({"boxes": {"16": [1, 2, 3, 4]}}, ["boxes", "16", "[key]"]),
        ({"gripper": {}}, ["gripper"]),
        ({"gripper": {"marker": 7, "log": "a.csv"}}, ["gripper"]),
        ({"plane": {"before_m": 0.1}}, ["plane"]),
        ({"kind": "unheard_of"}, ["kind"]),
        ({"masks": {"0": "a\\b"}}, ["masks", "0"]),
        ({"bokses": {}}, ["bokses"]),
    ],
)
def test_options_that_cannot_be_are_named(
    client: httpx.Client, pictures: bytes, options: dict[str, Any], where: list[object]
) -> None:
    problem = assert_problem(send(client, "", pictures, options=json.dumps(options)), 422, "invalid_request")
    assert problem["errors"][0]["loc"] == ["body", "options", *where]
