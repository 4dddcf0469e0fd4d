"""Datasets, models, libraries and files: what the rest of the API gives out."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pyarrow.parquet as parquet
import pytest
from api_service import EPISODE, Service, assert_problem, scene_id, sha256
from physworld_client.export import FORMATS
from serving import log_in

from physworld.materials.library import ELASTIC_LAWS
from physworld.materials.plastic import PLASTICITIES
from physworld_scenes import importers
from physworld_storage import resources

CONTENT = bytes(range(256)) * 40


@pytest.fixture(scope="module")
def chain(service: Service) -> dict[str, Any]:
    """The outputs of one pipeline."""
    with service.client() as client:
        body = {"scene_id": scene_id(client), "model_name": "strip", "dataset": {"episodes": 3}}
        job = client.post("/v1/pipelines", json=body).json()
        service.work()
        outputs = client.get(f"/v1/jobs/{job['id']}").json()["outputs"]
    return {output["kind"]: output["id"] for output in outputs}


@pytest.fixture(scope="module")
def digest(service: Service) -> str:
    """A stored file."""
    return service.stores.artifacts.put_bytes(CONTENT, "numbers.bin").sha256


def test_episodes_are_listed_and_downloaded(client: httpx.Client, chain: dict[str, Any]) -> None:
    address = f"/v1/datasets/{chain['dataset']}/episodes"
    page = client.get(address, params={"limit": 2}).json()
    rest = client.get(address, params={"limit": 2, "cursor": page["next_cursor"]}).json()
    assert [episode["index"] for episode in page["data"] + rest["data"]] == [0, 1, 2]
    response = client.get(f"{address}/1")
    with np.load(io.BytesIO(response.content), allow_pickle=False) as arrays:
        for name, array in EPISODE.items():
            np.testing.assert_array_equal(arrays[name], array)
        assert str(arrays["attributes"]) == '{"motion": "bezier"}'
    assert_problem(client.get(f"{address}/3"), 404, "not_found")
    for index in ("-1", "x", str(2**31), "1.5"):
        assert_problem(client.get(f"{address}/{index}"), 422, "invalid_request")


def test_lists_filter_by_what_things_are_made_of(client: httpx.Client, chain: dict[str, Any]) -> None:
    found = client.get("/v1/datasets", params={"fit_id": chain["fit"], "state": "sealed"}).json()["data"]
    assert [item["id"] for item in found] == [chain["dataset"]]
    assert client.get("/v1/datasets", params={"fit_id": "fit_none"}).json()["data"] == []
    fits = client.get("/v1/fits", params={"scene_id": found[0]["scene_id"], "state": "ready"}).json()["data"]
    assert [item["id"] for item in fits] == [chain["fit"]]
    assert client.get("/v1/scenes", params={"kind": "rope"}).json()["data"] == []


def test_versions_are_found_by_number_alias_and_latest(client: httpx.Client, chain: dict[str, Any]) -> None:
    assert chain["model"] == "strip:1"
    moved = client.put("/v1/models/strip/aliases/champion", json={"version": 1})
    assert moved.json()["aliases"] == {"champion": 1}
    versions = [
        client.get(f"/v1/models/strip/versions/{name}").json() for name in ("1", "champion", "latest")
    ]
    assert versions[0] == versions[1] == versions[2]
    assert versions[0]["aliases"] == ["champion"]
    assert [model["name"] for model in client.get("/v1/models").json()["data"]] == ["strip"]
    assert client.get("/v1/models/strip").json()["latest_version"] == 1
    assert client.delete("/v1/models/strip/aliases/champion").json()["aliases"] == {}


def test_aliases_need_a_ready_version_and_a_sound_name(client: httpx.Client, chain: dict[str, Any]) -> None:
    body = {"name": "strip", "dataset_id": chain["dataset"]}
    job = client.post("/v1/models", json=body).json()
    assert job["outputs"][0]["id"] == "strip:2"
    assert_problem(client.put("/v1/models/strip/aliases/next", json={"version": 2}), 409, "conflict")
    assert_problem(client.put("/v1/models/strip/aliases/next", json={"version": 9}), 404, "not_found")
    assert_problem(client.put("/v1/models/strip/aliases/latest", json={"version": 1}), 409, "conflict")
    assert_problem(client.put("/v1/models/none/aliases/next", json={"version": 1}), 404, "not_found")
    for version in (0, -1, 2**63, "one", None):
        assert_problem(
            client.put("/v1/models/strip/aliases/a", json={"version": version}), 422, "invalid_request"
        )
    for name in ("Upper", "-x", "a" * 65, "%00"):
        assert_problem(client.get(f"/v1/models/{name}"), 422, "invalid_request")
    for version in ("0", "01", "Champion", "9" * 12):
        assert_problem(client.get(f"/v1/models/strip/versions/{version}"), 422, "invalid_request")
    client.post(f"/v1/jobs/{job['id']}/cancel")


def test_libraries_name_the_laws_that_a_fit_chooses_from(client: httpx.Client) -> None:
    laws = {(law["kind"], law["name"]): law for law in client.get("/v1/materials").json()["data"]}
    assert [name for kind, name in laws if kind == "elastic"] == list(ELASTIC_LAWS)
    assert [name for kind, name in laws if kind == "flow"] == list(PLASTICITIES)
    assert laws["elastic", "rod"]["parameters"]["stretching_n"]["unit"] == "N"
    effects = {effect["name"]: effect for effect in client.get("/v1/effects").json()["data"]}
    rate = effects["air_drag_linear"]["parameters"]["rate_per_s"]
    assert (rate["unit"], rate["default"], rate["gate"]) == ("1/s", 0.0, True)
    assert rate["bounds"] == {shape: [0.0, 30.0] for shape in ("solid", "sheet", "rod")}
    metrics = {metric["name"]: metric for metric in client.get("/v1/metrics").json()["data"]}
    assert metrics["track_m"]["listed"] and not metrics["track_phystwin_m"]["listed"]
    assert [one["name"] for one in client.get("/v1/importers").json()["data"]] == [
        one.name for one in (*importers.IMPORTERS, *importers.FOLDERS)
    ]
    assert [one["name"] for one in client.get("/v1/exports").json()["data"]] == list(FORMATS)


def test_a_law_that_the_catalogue_does_not_have_is_refused(client: httpx.Client) -> None:
    scene = scene_id(client)
    body = {"scene_id": scene, "config": {"law": "elastic_sheet", "plasticity": "butter"}}
    problem = assert_problem(client.post("/v1/fits", json=body), 422, "invalid_request")
    assert [fault["loc"] for fault in problem["errors"]] == [
        ["body", "config", "law"],
        ["body", "config", "plasticity"],
    ]
    assert "no law 'elastic_sheet'; GET /v1/materials lists them" in problem["detail"]
    pipeline = {"scene_id": scene, "fit": {"law": "elastic_rod"}}
    assert_problem(client.post("/v1/pipelines", json=pipeline), 422, "invalid_request")


def test_file_is_streamed_with_its_digest(client: httpx.Client, digest: str) -> None:
    response = client.get(f"/v1/artifacts/{digest}")
    assert response.content == CONTENT
    assert response.headers["ETag"] == f'"{digest}"'
    assert response.headers["Content-Length"] == str(len(CONTENT))
    wanted = f"sha-256=:{base64.b64encode(hashlib.sha256(CONTENT).digest()).decode()}:"
    assert response.headers["Content-Digest"] == response.headers["Repr-Digest"] == wanted
    head = client.head(f"/v1/artifacts/{digest}")
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["Content-Length"] == str(len(CONTENT))
    assert head.headers["Accept-Ranges"] == "bytes"


def test_file_that_the_client_has_is_not_sent_again(client: httpx.Client, digest: str) -> None:
    for tags in (f'"{digest}"', f'W/"{digest}"', f'"other", "{digest}"', "*"):
        response = client.get(f"/v1/artifacts/{digest}", headers={"If-None-Match": tags})
        assert (response.status_code, response.content) == (304, b""), tags
    other = client.get(f"/v1/artifacts/{digest}", headers={"If-None-Match": '"other"'})
    assert other.status_code == 200


@pytest.mark.parametrize(
    ("header", "start", "end"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=100-", 100, 10240),
        ("bytes=-100", 10140, 10240),
        ("bytes=-99999", 0, 10240),
        ("bytes=10239-99999", 10239, 10240),
        ("bytes=5-9", 5, 10),
    ],
)
def test_ranges(client: httpx.Client, digest: str, header: str, start: int, end: int) -> None:
    response = client.get(f"/v1/artifacts/{digest}", headers={"Range": header})
    assert response.status_code == 206
    assert response.content == CONTENT[start:end]
    assert response.headers["Content-Range"] == f"bytes {start}-{end - 1}/{len(CONTENT)}"
    assert response.headers["Content-Length"] == str(end - start)
    assert "Content-Digest" not in response.headers


@pytest.mark.parametrize("header", ["bytes=10240-", "bytes=99999-100000", "bytes=-0"])
def test_ranges_past_the_end(client: httpx.Client, digest: str, header: str) -> None:
    response = client.get(f"/v1/artifacts/{digest}", headers={"Range": header})
    assert_problem(response, 416, "range_not_satisfiable")
    assert response.headers["Content-Range"] == "bytes */10240"


@pytest.mark.parametrize(
    "header",
    ["bytes=9-5", "bytes=0-1,3-4", "lines=0-1", "bytes=-", "bytes=a-b", "bytes", f"bytes=0-{'9' * 5000}"],
)
def test_ranges_that_a_server_may_ignore(client: httpx.Client, digest: str, header: str) -> None:
    response = client.get(f"/v1/artifacts/{digest}", headers={"Range": header})
    assert (response.status_code, len(response.content)) == (200, len(CONTENT))


def test_a_download_resumes_only_the_same_file(client: httpx.Client, digest: str) -> None:
    same = client.get(f"/v1/artifacts/{digest}", headers={"Range": "bytes=5-", "If-Range": f'"{digest}"'})
    assert same.status_code == 206
    other = client.get(f"/v1/artifacts/{digest}", headers={"Range": "bytes=5-", "If-Range": '"other"'})
    assert (other.status_code, len(other.content)) == (200, len(CONTENT))


def test_files_that_are_not_there(client: httpx.Client) -> None:
    assert_problem(client.get(f"/v1/artifacts/{sha256(b'nothing')}"), 404, "not_found")
    assert client.head(f"/v1/artifacts/{sha256(b'nothing')}").status_code == 404
    for name in ("x", "..%2f..%2fphysworld.db", "A" * 64, "0" * 63):
        assert client.get(f"/v1/artifacts/{name}").status_code in (404, 422)


def test_an_empty_file(client: httpx.Client, service: Service) -> None:
    empty = service.stores.artifacts.put_bytes(b"", "empty").sha256
    response = client.get(f"/v1/artifacts/{empty}")
    assert (response.status_code, response.content) == (200, b"")
    assert client.get(f"/v1/artifacts/{empty}", headers={"Range": "bytes=0-"}).status_code == 416


def test_an_episode_that_lost_a_chunk_is_not_given_out(service: Service) -> None:
    with service.client() as client:
        body = {"scene_id": scene_id(client, "damaged"), "dataset": {"episodes": 1}}
        job = client.post("/v1/pipelines", json=body).json()
        service.work()
        outputs = client.get(f"/v1/jobs/{job['id']}").json()["outputs"]
        dataset = next(output["id"] for output in outputs if output["kind"] == "dataset")
        address = f"datasets/{dataset}/episodes/0"
        cookie = log_in(service.url, service.token("admin"))
        assert client.get(f"/v1/{address}").status_code == 200
        assert client.get(f"/dashboard/{address}/cloud", headers=cookie).status_code == 200
        with service.database.reading() as session:
            path = resources.get_episode(session, dataset, 0).path
        assert service.settings.store_folder is not None
        file = service.settings.store_folder / path
        with zipfile.ZipFile(file) as archive:
            kept = {name: archive.read(name) for name in archive.namelist() if "particles/c/" not in name}
        with zipfile.ZipFile(file, "w") as archive:
            for name, content in kept.items():
                archive.writestr(name, content)
        problem = assert_problem(client.get(f"/v1/{address}"), 500, "episode_corrupt")
        assert "particles do not have the digest" in problem["detail"]
        shown = client.get(f"/dashboard/{address}/cloud", headers=cookie)
        assert shown.status_code == 500 and "particles do not have the digest" in shown.text


@pytest.mark.parametrize("form", sorted(FORMATS))
def test_a_dataset_is_exported_as_one_zip(
    client: httpx.Client, chain: dict[str, Any], form: str, tmp_path: Path
) -> None:
    response = client.get(f"/v1/datasets/{chain['dataset']}/export", params={"format": form, "points": 5})
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "application/zip"
    assert f'filename="{chain["dataset"]}-{form}.zip"' in response.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(response.content)) as archive:
        assert archive.testzip() is None
        archive.extractall(tmp_path)
    top = tmp_path / chain["dataset"]
    assert json.loads((top / "dataset.json").read_text())["id"] == chain["dataset"]
    frames = len(EPISODE["times"])
    if form == "npz":
        with np.load(top / "episode-00001.npz", allow_pickle=False) as arrays:
            np.testing.assert_array_equal(arrays["particles"], EPISODE["particles"])
            assert str(arrays["attributes"]) == '{"motion": "bezier"}'
    elif form == "ply":
        assert len(list(top.glob("episode-0000?/frame-*.ply"))) == 3 * frames
    else:
        info = json.loads((top / "meta/info.json").read_text())
        assert (info["codebase_version"], info["total_episodes"], info["total_frames"]) == (
            "v3.0",
            3,
            3 * frames,
        )
        table = parquet.read_table(top / "data/chunk-000/file-000.parquet")
        assert table.num_rows == 3 * frames
        assert info["features"]["observation.environment_state"]["shape"] == [
            3 * min(5, EPISODE["particles"].shape[1])
        ]


def test_what_cannot_be_exported_is_refused(
    client: httpx.Client, chain: dict[str, Any], service: Service
) -> None:
    address = f"/v1/datasets/{chain['dataset']}/export"
    assert_problem(client.get(address, params={"format": "hdf5"}), 422, "invalid_request")
    assert_problem(client.get(address, params={"points": 0}), 422, "invalid_request")
    assert_problem(client.get("/v1/datasets/dst_00000000000000000000000000/export"), 404, "not_found")
    job = client.post("/v1/datasets", json={"fit_id": chain["fit"]}).json()
    assert_problem(client.get(f"/v1/datasets/{job['outputs'][0]['id']}/export"), 409, "conflict")
    client.post(f"/v1/jobs/{job['id']}/cancel")
