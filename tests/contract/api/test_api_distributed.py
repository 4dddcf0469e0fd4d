"""Configuration alone moves the service: the same application on Postgres and an S3 object store.

Runs where ``PHYSWORLD_TEST_POSTGRES_URL`` names a server on which databases may be made; the object store is
moto's server over real HTTP.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import boto3
import pytest
from api_service import Service, ask, assert_problem, bundle, scene_id, upload
from conftest import serve
from moto.server import ThreadedMotoServer

from physworld_services.web import create_app
from physworld_storage.settings import get_settings


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """Address of an object store that has the bucket ``recordings``."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    client = boto3.client(
        "s3",
        endpoint_url=endpoint,
        region_name="us-east-1",
        aws_access_key_id="test-access",
        aws_secret_access_key="test-secret",
    )
    client.create_bucket(Bucket="recordings")
    yield endpoint
    server.stop()


@pytest.fixture(scope="module")
def service(postgres_url: str, bucket: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The web application, told by the environment alone where its data lies."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("PHYSWORLD_DATA_DIR", str(tmp_path_factory.mktemp("unused")))
        environment.setenv("PHYSWORLD_DATABASE_URL", postgres_url)
        environment.setenv("PHYSWORLD_STORE_URL", "s3://recordings/installation-1")
        environment.setenv("PHYSWORLD_S3_ENDPOINT", bucket)
        environment.setenv("PHYSWORLD_S3_ACCESS_KEY_ID", "test-access")
        environment.setenv("PHYSWORLD_S3_SECRET_ACCESS_KEY", "test-secret")
        get_settings.cache_clear()
        settings = get_settings()
        get_settings.cache_clear()
    yield from serve(settings)


def test_the_whole_chain_runs_on_postgres_and_s3(service: Service) -> None:
    with service.client() as client:
        assert client.get("/health/ready").json()["checks"] == {"database": "ok", "store": "ok"}
        created = upload(client, bundle("far away"))
        assert created.status_code == 201, created.text
        assert upload(client, bundle("far away")).status_code == 200
        body = {"scene_id": created.json()["id"], "dataset": {"episodes": 2}}
        headers = {"Idempotency-Key": "far"}
        job = client.post("/v1/pipelines", json=body, headers=headers)
        assert job.status_code == 202, job.text
        assert client.post("/v1/pipelines", json=body, headers=headers).content == job.content
        assert service.work() == 6
        done = client.get(f"/v1/jobs/{job.json()['id']}").json()
        assert done["state"] == "succeeded"
        version = client.get(done["links"]["model"]).json()
        archive = client.get(f"/v1/artifacts/{version['sha256']}", headers={"Range": "bytes=1-4"})
        assert (archive.status_code, len(archive.content)) == (206, 4)
        assert client.get(f"/v1/datasets/{version['dataset_id']}/episodes/1").status_code == 200
        assert 'physworld_jobs{kind="pipeline",state="succeeded"} 1.0' in client.get("/metrics").text
    folder = service.settings.data_dir
    assert not Path(folder / "physworld.db").exists() and not Path(folder / "store").exists()


def test_text_that_postgres_cannot_keep_is_refused(service: Service) -> None:
    with service.client() as client:
        for path in ("/v1/jobs?cursor=WyIyMDI2LTAxLTAxVDAwOjAwOjAwKzAwOjAwIiwgIlx1MDAwMCJd",):
            assert client.get(path).status_code == 422
        assert_problem(client.post("/v1/fits", json={"scene_id": "a\0"}), 422, "invalid_request")
        scene = scene_id(client)
        assert_problem(
            client.post("/v1/pipelines", json={"scene_id": scene, "dataset": {"seed": 2**63}}),
            422,
            "invalid_request",
        )


def test_a_lost_postgres_is_503(service: Service) -> None:
    settings = service.settings.model_copy(update={"database_url": "postgresql://physworld@127.0.0.1:9/none"})
    app = create_app(settings)
    assert_problem(ask(app, "/health/ready"), 503, "database_unavailable")
    refused = ask(app, "/v1/jobs", {"Authorization": "Bearer " + "x" * 40})
    assert_problem(refused, 503, "database_unavailable")
