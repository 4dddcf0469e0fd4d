"""A downloaded model is verified before anything of it is read."""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path

import pytest
from physworld_client.errors import DigestMismatch, ModelUnreadable
from physworld_client.manifest import artifacts_of, verify_folder

from physworld_schemas.base import Artifact
from physworld_schemas.model import ModelVersion

CONTENT = {"model.safetensors": b"weights", "card.json": b"{}"}


def write_model(folder: Path, names: dict[str, bytes] | None = None) -> str:
    folder.mkdir(exist_ok=True)
    files = {}
    for name, data in (names or CONTENT).items():
        files[name] = {"sha256": hashlib.sha256(data).hexdigest(), "size": len(data)}
        (folder / name).write_bytes(data)
    manifest = json.dumps({"name": "beam", "version": 2, "files": files}).encode()
    (folder / "manifest.json").write_bytes(manifest)
    return hashlib.sha256(manifest).hexdigest()


def test_an_untouched_model_passes(tmp_path: Path) -> None:
    digest = write_model(tmp_path)
    assert verify_folder(tmp_path, digest).version == 2


@pytest.mark.parametrize("data", [b"Weights", b"weights and more"], ids=["changed", "longer"])
def test_a_changed_file_is_found(tmp_path: Path, data: bytes) -> None:
    write_model(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(data)
    with pytest.raises(DigestMismatch, match=r"model\.safetensors"):
        verify_folder(tmp_path)


def test_another_manifest_is_found(tmp_path: Path) -> None:
    write_model(tmp_path)
    with pytest.raises(DigestMismatch, match=r"manifest.json.*expected 0000"):
        verify_folder(tmp_path, "0" * 64)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    write_model(tmp_path)
    (tmp_path / "card.json").unlink()
    with pytest.raises(ModelUnreadable, match=r"lacks card.json"):
        verify_folder(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", '{"name": "beam", "version": 1}'])
def test_what_is_no_manifest_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ModelUnreadable, match="is not a manifest"):
        verify_folder(tmp_path)


@pytest.mark.parametrize("name", ["../card.json", "/etc/card.json", "a\\b", ""])
def test_a_file_name_never_leaves_its_folder(tmp_path: Path, name: str) -> None:
    manifest = {"name": "beam", "version": 1, "files": {name: {"sha256": "0" * 64, "size": 1}}}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ModelUnreadable, match="leaves its folder"):
        verify_folder(tmp_path)
    artifact = Artifact(name=name, sha256="0" * 64, size=1)
    manifest_file = Artifact(name="manifest.json", sha256="1" * 64, size=1)
    version = ModelVersion(
        name="beam",
        version=1,
        state="ready",
        created_at=datetime.now(UTC),
        sha256="1" * 64,
        artifacts=[manifest_file, artifact],
    )
    with pytest.raises(ModelUnreadable, match="leaves its folder"):
        artifacts_of(version)


def test_a_version_that_is_not_ready_has_nothing_to_download() -> None:
    now = datetime.now(UTC)
    version = ModelVersion(name="beam", version=3, state="failed", message="diverged", created_at=now)
    with pytest.raises(ModelUnreadable, match="beam version 3 is failed: diverged"):
        artifacts_of(version)
