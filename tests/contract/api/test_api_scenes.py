"""Uploading scenes: accepted once, refused with every fault named, hostile files held off."""

from __future__ import annotations

import io
import pickle
import struct
import tarfile
import zipfile
from collections.abc import Iterator

import httpx
import numpy as np
from api_service import Service, archive, assert_problem, bundle, scene_id, upload
from conftest import MAX_UPLOAD_BYTES


class Calls:
    """A pickle that calls something when it is loaded."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return print, ("called",)


def test_scene_is_created_once_and_found_again(client: httpx.Client) -> None:
    first = upload(client, bundle("once"))
    assert first.status_code == 201, first.text
    scene = first.json()
    assert first.headers["Location"] == f"/v1/scenes/{scene['id']}"
    assert (scene["frames"], scene["points"], scene["controllers"]) == (20, 9, 1)
    assert scene["train"] == [0, 14]
    again = upload(client, bundle("once"), filename="another.zip")
    assert again.status_code == 200
    assert again.json() == scene
    assert client.get(first.headers["Location"]).json() == scene
    archived = client.get(f"/v1/artifacts/{scene['artifacts'][0]['sha256']}")
    assert upload(client, archived.content).json()["id"] == scene["id"]


def test_name_of_the_form_overrides_the_file(client: httpx.Client) -> None:
    renamed = upload(client, bundle("original"), name="renamed")
    assert renamed.status_code == 201
    assert renamed.json()["name"] == "renamed"
    assert renamed.json()["id"] != upload(client, bundle("original")).json()["id"]


def test_tar_is_as_good_as_zip(client: httpx.Client) -> None:
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(bundle("packed"))) as source,
        tarfile.open(fileobj=buffer, mode="w:gz") as target,
    ):
        for name in source.namelist():
            member = tarfile.TarInfo(f"packed/{name}")
            member.size = source.getinfo(name).file_size
            target.addfile(member, source.open(name))
    assert (
        upload(client, buffer.getvalue(), "packed.tar.gz").json()["id"]
        == (upload(client, bundle("packed")).json()["id"])
    )


def test_invalid_scene_names_every_fault(client: httpx.Client) -> None:
    points = np.zeros((20, 9, 3), np.float32)
    points[3, 4] = np.nan
    response = upload(client, bundle(arrays={"points": points, "times": np.zeros(20)}, fps=-1.0))
    problem = assert_problem(response, 422, "scene_invalid")
    assert len(problem["errors"]) >= 2
    assert all(fault["loc"] and fault["msg"] for fault in problem["errors"])


def test_upload_over_the_limit_is_413_with_both_numbers(client: httpx.Client) -> None:
    declared = assert_problem(upload(client, b"\0" * (MAX_UPLOAD_BYTES + 100_000)), 413, "content_too_large")
    assert str(MAX_UPLOAD_BYTES) in declared["detail"]
    slightly = assert_problem(upload(client, b"\0" * (MAX_UPLOAD_BYTES + 1)), 413, "content_too_large")
    assert f"{MAX_UPLOAD_BYTES + 1} bytes" in slightly["detail"]


def test_upload_without_a_declared_length_is_counted(client: httpx.Client) -> None:
    def pieces() -> Iterator[bytes]:
        yield b'--b\r\nContent-Disposition: form-data; name="bundle"; filename="x"\r\n\r\n'
        for _ in range(50):
            yield b"\0" * 10_000
        yield b"\r\n--b--\r\n"

    response = client.post(
        "/v1/scenes", content=pieces(), headers={"Content-Type": "multipart/form-data; boundary=b"}
    )
    problem = assert_problem(response, 413, "content_too_large")
    assert str(MAX_UPLOAD_BYTES) in problem["detail"]


def test_form_faults(client: httpx.Client) -> None:
    assert_problem(client.post("/v1/scenes", json={}), 415, "unsupported_media_type")
    assert_problem(client.post("/v1/scenes"), 415, "unsupported_media_type")
    missing = assert_problem(client.post("/v1/scenes", files={"file": ("a", b"x")}), 422, "invalid_request")
    assert {tuple(fault["loc"]) for fault in missing["errors"]} == {("body", "file"), ("body", "bundle")}
    broken = client.post(
        "/v1/scenes", content=b"garbage", headers={"Content-Type": "multipart/form-data; boundary=x"}
    )
    assert broken.status_code in (400, 422)
    assert_problem(
        client.post("/v1/scenes", data={"bundle": "text"}, files={"name": b"x"}), 422, "invalid_request"
    )
    bad = upload(client, bundle(), options='{"up": "sideways", "kind": "ghost", "speed": 1}')
    assert {fault["loc"][-1] for fault in assert_problem(bad, 422, "invalid_request")["errors"]} == {
        "up",
        "speed",
    }
    assert_problem(upload(client, bundle(), options='{"kind": "ghost"}'), 422, "invalid_request")
    assert_problem(upload(client, bundle(), name="a/b"), 422, "invalid_request")
    two = client.post("/v1/scenes", files=[("bundle", ("a", b"x")), ("bundle", ("b", b"y"))])
    assert_problem(two, 400, "bad_request")


def test_hostile_files_are_refused(client: httpx.Client) -> None:
    hostile = {
        "empty": b"",
        "text": b"hello",
        "pickle that calls": pickle.dumps({"object_points": Calls()}),
        "truncated pickle": pickle.dumps(list(range(1000)))[:500],
        "climbing archive": archive({"../scene.json": b"{}", "scene.npz": b""}),
        "absolute archive": archive({"/etc/scene.json": b"{}", "scene.npz": b""}),
        "archive without a scene": archive({"readme.txt": b"hello"}),
        "bomb": _bomb(),
        "link": _linked_tar(),
        "name of no UTF-8": _tar_named("caf\udce9/scene.json"),
        "object array": bundle(arrays={"points": np.array([Calls()], dtype=object)}),
        "damaged zip": bundle()[:-200],
        "huge header": _huge_npy(),
    }
    for name, data in hostile.items():
        problem = assert_problem(upload(client, data, name), 422, "scene_invalid")
        assert problem["errors"], name


def test_nobody_uploads_without_a_key(service: Service) -> None:
    with service.client(None) as stranger:
        assert_problem(upload(stranger, bundle()), 401, "unauthenticated")
    with service.client("read") as reader:
        assert_problem(upload(reader, bundle()), 403, "forbidden")


def _bomb() -> bytes:
    """A zip whose scene.npz inflates from 100 kB to 100 MB."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("scene.json", b"{}")
        file.writestr("scene.npz", b"\0" * 100_000_000)
    return buffer.getvalue()


def _tar_named(name: str) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        member = tarfile.TarInfo(name)
        member.type, member.linkname = tarfile.SYMTYPE, "/etc/passwd"  # refused with its name
        archive.addfile(member)
    return buffer.getvalue()


def _linked_tar() -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as file:
        member = tarfile.TarInfo("scene.json")
        member.type, member.linkname = tarfile.SYMTYPE, "/etc/passwd"
        file.addfile(member)
        file.addfile(tarfile.TarInfo("scene.npz"))
    return buffer.getvalue()


def _huge_npy() -> bytes:
    """An array whose header claims 8 TB."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000, 1000), }"
    header = header.ljust(117) + b"\n"
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    return archive({"scene.json": b"{}", "scene.npz": archive({"points.npy": array})})


def test_tags_of_a_scene_are_set_and_searched_by(client: httpx.Client) -> None:
    address = f"/v1/scenes/{scene_id(client)}"
    before = client.get(address).json()
    changed = client.patch(address, json={"tags": ["soft", "Tag zwei", "größer", "soft"]})
    assert changed.status_code == 200, changed.text
    assert changed.json() == client.get(address).json() == {**before, "tags": ["soft", "Tag zwei", "größer"]}
    for tag in ("soft", "tag ZWEI", "größer"):
        found = client.get("/v1/scenes", params={"tag": tag}).json()["data"]
        assert [item["id"] for item in found] == [before["id"]]
    for tag in ("sof", "zwei", "%"):
        assert client.get("/v1/scenes", params={"tag": tag}).json()["data"] == []
    assert_problem(client.patch(address, json={"tags": [""]}), 422, "invalid_request")
    assert_problem(client.patch(address, json={"name": "other"}), 422, "invalid_request")
    assert_problem(
        client.patch("/v1/scenes/scn_00000000000000000000000000", json={"tags": []}), 404, "not_found"
    )
    assert client.patch(address, json={"tags": []}).json()["tags"] == []
