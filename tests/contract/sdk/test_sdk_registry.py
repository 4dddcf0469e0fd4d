"""The registry through API, SDK and command line: aliases, descriptions, comparisons, signatures."""

from __future__ import annotations

from pathlib import Path

import pytest
from physworld_client import Client
from physworld_client.cli.app import app
from physworld_client.errors import Conflict, NotFound, SignatureInvalid
from physworld_client.signatures import known_keys
from sdk_service import Service, write_scene
from typer.testing import CliRunner

from schemas.dataset import DatasetConfig
from schemas.model import TrainingConfig
from storage import registry


@pytest.fixture(scope="module")
def name(service: Service, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A model with two ready versions and a pending one."""
    with service.client() as client:
        scene = client.scenes.create(
            write_scene(tmp_path_factory.mktemp("registry") / "s", "registry", seed=77)
        )
        fit = client.fits.create(scene.id)
        service.work()
        dataset = client.datasets.create(client.jobs.wait(fit).outputs[0].id, DatasetConfig(episodes=2))
        service.work()
        dataset_id = client.jobs.wait(dataset).outputs[0].id
        for steps in (1, 2):
            client.models.create("paired", dataset_id, TrainingConfig(steps=steps))
            service.work()
        client.models.create("paired", dataset_id)
    return "paired"


def test_an_alias_stands_wherever_a_version_does_and_can_be_taken_away(client: Client, name: str) -> None:
    client.models.set_alias(name, "champion", 1)
    client.models.set_alias(name, "champion", 2)
    assert client.models.version(name, "champion").version == 2
    assert client.models.update(name, "champion", description="the best").version == 2
    assert client.models.compare(name, 1, "champion").b == 2
    assert client.models.delete_alias(name, "champion").aliases == {}
    with pytest.raises(NotFound, match="champion"):
        client.models.version(name, "champion")
    with pytest.raises(NotFound):
        client.models.delete_alias(name, "champion")
    with pytest.raises(Conflict, match="pending"):
        client.models.set_alias(name, "champion", 3)


def test_only_description_and_tags_of_a_version_change(client: Client, name: str) -> None:
    before = client.models.version(name, 1)
    changed = client.models.update(name, 1, description="first", tags=("robot", "lab", "robot"))
    assert (changed.description, changed.tags) == ("first", ["robot", "lab"])
    assert client.models.update(name, 1, tags=()).description == "first"
    after = client.models.version(name, 1)
    assert after == before.model_copy(update={"description": "first", "tags": []})
    answer = client.http.patch(f"/v1/models/{name}/versions/1", json={"tags": ["x" * 65]})
    assert (answer.status_code, answer.json()["errors"][0]["loc"]) == (422, ["body", "tags", 0])
    assert client.http.patch(f"/v1/models/{name}/versions/1", json={"sha256": "0" * 64}).status_code == 422


def test_two_versions_are_compared(client: Client, name: str) -> None:
    found = client.models.compare(name, 1, 2)
    assert {item.field: (item.a, item.b) for item in found.differences} == {"config.steps": (1, 2)}
    assert {item.predictor for item in found.errors} >= {"twin", "static", "world_model_finetuned"}
    with pytest.raises(Conflict, match="pending"):
        client.models.compare(name, 1, 3)
    with pytest.raises(NotFound):
        client.models.compare(name, 1, 9)


def test_a_download_is_verified_with_the_services_key_or_with_the_one_given(
    service: Service, client: Client, name: str, tmp_path: Path
) -> None:
    client.models.download(name, tmp_path / "one", 1)
    (key,) = client.models.signing_keys()
    assert known_keys()[key.key_id] == key.public_key
    client.models.download(name, tmp_path / "two", 1, public_key=key.public_key)
    other = "AAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8="
    with pytest.raises(SignatureInvalid, match=f"{key.key_id}, which is not known here"):
        client.models.download(name, tmp_path / "three", 1, public_key=other)


def test_a_version_of_another_manifest_than_its_signature_is_refused(
    service: Service, client: Client, name: str, tmp_path: Path
) -> None:
    """Somebody replaced manifest and digest in the database and the store, but has no key."""
    forged = service.stores.artifacts.put_bytes(
        b'{"name": "paired", "version": 2, "files": {}}', "manifest.json"
    )
    with service.database.session() as session:
        row = registry.version_row(session, name, 2)
        was, digest = row.artifacts, row.sha256
        row.artifacts = [forged.model_dump() if item["name"] == "manifest.json" else item for item in was]
        row.sha256 = forged.sha256
    try:
        with pytest.raises(SignatureInvalid, match="was changed"):
            client.models.download(name, tmp_path / "forged", 2)
    finally:
        with service.database.session() as session:
            row = registry.version_row(session, name, 2)
            row.artifacts, row.sha256 = was, digest


def test_the_command_line_does_the_same(service: Service, name: str, tmp_path: Path) -> None:
    place = ["--url", service.url, "--token", service.token]
    run = CliRunner().invoke
    compared = run(app, ["models", "compare", name, "1", "2", *place])
    assert compared.exit_code == 0, compared.output
    for text in ("version 1", "version 2", "config.steps", "world_model_finetuned", "steps_per_second"):
        assert text in compared.output
    described = run(app, ["models", "describe", name, "--version", "2", "--tag", "lab", *place])
    assert described.exit_code == 0 and '["lab"]' in described.output
    assert run(app, ["models", "alias", name, "robot", "2", *place]).exit_code == 0
    assert run(app, ["models", "unalias", name, "robot", *place]).exit_code == 0
    folder = tmp_path / "downloaded"
    assert run(app, ["models", "download", name, "--version", "1", "-o", str(folder), *place]).exit_code == 0
    keys = run(app, ["models", "keys", *place])
    assert keys.exit_code == 0 and "ed25519" in keys.output
    verified = run(app, ["models", "verify", str(folder)])
    assert verified.exit_code == 0 and "the signature are good" in verified.output
    (folder / "card.json").write_bytes(b"{ }")
    refused = run(app, ["models", "verify", str(folder)])
    assert refused.exit_code != 0
