"""The registry through API, SDK and command line: aliases, descriptions, comparisons, signatures."""

from __future__ import annotations

import asyncio
import base64
import json
from pathlib import Path

import pytest
from click.testing import Result
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from physworld_client import AsyncClient, Client
from physworld_client.cli.app import app
from physworld_client.errors import Conflict, NotFound, SignatureInvalid, SigningKeyUntrusted
from physworld_client.known_keys import KnownKeys
from physworld_client.signatures import fingerprint_of
from sdk_service import Service, write_scene
from typer.testing import CliRunner

from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.model import TrainingConfig
from physworld_storage import registry


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
    assert client.known_keys.of(service.url) == {fingerprint_of(key.public_key): key.public_key}
    client.models.download(name, tmp_path / "two", 1, public_key=key.public_key)
    other = "AAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8="
    with pytest.raises(SigningKeyUntrusted, match=f"{key.key_id}, which is not the key that was given"):
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


@pytest.mark.parametrize("kind", ["sync", "async"])
def test_a_service_whose_key_changed_is_refused_until_the_new_key_is_trusted(
    service: Service, name: str, tmp_path: Path, kind: str
) -> None:
    """This machine knows the address with another key: what a thief of the address, or a rotation, looks like."""
    other = base64.b64encode(Ed25519PrivateKey.generate().public_key().public_bytes_raw()).decode()
    file = tmp_path / "known.json"
    KnownKeys(file).trust(service.url, other)
    with service.client(known_keys=file) as client:
        (listed,) = client.models.signing_keys()
        new = fingerprint_of(listed.public_key)
        if kind == "sync":
            with pytest.raises(SigningKeyUntrusted) as found:
                client.models.download(name, tmp_path / "one", 1)
            client.models.download(name, tmp_path / "one", 1, trust=new)
            client.models.distrust(fingerprint_of(other))
            client.models.download(name, tmp_path / "two", 1)
        else:
            found = asyncio.run(_refused_then_trusted(service, name, tmp_path, file, new))
        assert (found.value.signer, found.value.trusted) == (new, (fingerprint_of(other),))
        assert f"models trust {new}" in str(found.value)
        client.models.distrust(new)
        with pytest.raises(SigningKeyUntrusted):
            client.models.download(name, tmp_path / "one", 1)


async def _refused_then_trusted(
    service: Service, name: str, folder: Path, file: Path, new: str
) -> pytest.ExceptionInfo[SigningKeyUntrusted]:
    async with AsyncClient(service.url, service.token, known_keys=file) as client:
        with pytest.raises(SigningKeyUntrusted) as found:
            await client.models.download(name, folder / "one", 1)
        assert await client.models.trust(new) == new
        await client.models.download(name, folder / "one", 1)
    return found


def test_the_command_line_trusts_by_fingerprint_and_by_file(
    service: Service, client: Client, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PHYSWORLD_KNOWN_KEYS", str(tmp_path / "known.json"))
    other = base64.b64encode(Ed25519PrivateKey.generate().public_key().public_bytes_raw()).decode()
    (tmp_path / "other.pub").write_text(other)
    (listed,) = client.models.signing_keys()
    new = fingerprint_of(listed.public_key)
    place = ["--url", service.url, "--token", service.token]

    def run(*words: str) -> Result:
        return CliRunner().invoke(app, ["models", *words, *place])

    assert run("trust", str(tmp_path / "other.pub")).exit_code == 0
    refused = run("download", name, "--version", "1", "-o", str(tmp_path / "one"))
    assert refused.exit_code != 0 and isinstance(refused.exception, SigningKeyUntrusted)
    assert "no" in run("keys").output.split()
    trusted = run("trust", new)
    assert trusted.exit_code == 0 and f"{new} is trusted for {service.url}" in trusted.output
    assert "yes" in run("keys").output.split()
    assert run("download", name, "--version", "1", "-o", str(tmp_path / "one")).exit_code == 0
    assert run("distrust", new).exit_code == 0
    again = ("download", name, "--version", "1", "-o", str(tmp_path / "one"))
    assert run(*again).exit_code != 0
    assert run(*again, "--public-key", listed.public_key).exit_code == 0
    assert run(*again, "--trust", listed.public_key).exit_code == 0


def test_the_command_line_trusts_the_key_that_an_embedded_service_states_in_its_own_folder(
    service: Service, client: Client, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A data folder that was made anew has a new key under an old name."""
    monkeypatch.setenv("PHYSWORLD_KNOWN_KEYS", str(tmp_path / "known.json"))
    (listed,) = client.models.signing_keys()
    data = tmp_path / "data"
    (data / "run").mkdir(parents=True)
    (data / "api-key").write_text(service.token)
    state = {"api_url": service.url, "dashboard_url": service.url, "api_key_file": str(data / "api-key")}
    other = base64.b64encode(Ed25519PrivateKey.generate().public_key().public_bytes_raw()).decode()
    KnownKeys().trust(str(data), other)

    def download() -> Result:
        place = ["-o", str(tmp_path / "out"), "--data", str(data)]
        return CliRunner().invoke(app, ["models", "download", name, "--version", "1", *place])

    (data / "run" / "state.json").write_text(json.dumps(state))
    assert isinstance(download().exception, SigningKeyUntrusted)
    (data / "run" / "state.json").write_text(json.dumps({**state, "signing_key": listed.public_key}))
    found = download()
    assert found.exit_code == 0, found.output
    assert fingerprint_of(listed.public_key) in (KnownKeys().of(str(data)) or {})
    assert KnownKeys().of(service.url) is None, "an embedded service is known by its folder"


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
