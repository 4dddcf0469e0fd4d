"""A published model is loaded only when a key that is known here signed its manifest."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path

import pytest
from physworld_client.errors import DigestMismatch, SignatureInvalid, SigningKeyUntrusted
from physworld_client.known_keys import KnownKeys, trusted_keys
from physworld_client.manifest import verify_folder

from physworld_storage.signing import Signer, signer_of

OURS = signer_of(base64.b64encode(bytes(range(32))).decode(), "ours")
THEIRS = signer_of(base64.b64encode(bytes(range(1, 33))).decode(), "theirs")
WEIGHTS = bytes(1000)


@pytest.fixture(autouse=True)
def keys_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "config" / "known.json"
    monkeypatch.setenv("PHYSWORLD_KNOWN_KEYS", str(path))
    return path


def publish(folder: Path, signer: Signer, weights: bytes = WEIGHTS) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "model.safetensors").write_bytes(weights)
    entry = {"sha256": hashlib.sha256(weights).hexdigest(), "size": len(weights)}
    manifest = json.dumps({"name": "beam", "version": 2, "files": {"model.safetensors": entry}}).encode()
    (folder / "manifest.json").write_bytes(manifest)
    (folder / "manifest.sig.json").write_bytes(signer.sign(manifest))


def test_a_known_key_opens_a_model(tmp_path: Path) -> None:
    publish(tmp_path / "model", OURS)
    KnownKeys().trust("https://ours", OURS.public_key)
    assert verify_folder(tmp_path / "model", keys=trusted_keys(None)).version == 2
    assert verify_folder(tmp_path / "model", keys=trusted_keys(OURS.public_key)).version == 2


@pytest.mark.parametrize("place", [0, 500, 999])
def test_one_flipped_byte_of_a_file_is_found(tmp_path: Path, place: int) -> None:
    publish(tmp_path / "model", OURS)
    data = bytearray(WEIGHTS)
    data[place] ^= 1
    (tmp_path / "model" / "model.safetensors").write_bytes(data)
    with pytest.raises(DigestMismatch, match=r"model\.safetensors"):
        verify_folder(tmp_path / "model", keys=trusted_keys(OURS.public_key))


def test_a_manifest_that_was_adapted_to_changed_files_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    publish(folder, OURS)
    signature = (folder / "manifest.sig.json").read_bytes()
    publish(folder, OURS, weights=b"other weights")
    (folder / "manifest.sig.json").write_bytes(signature)
    with pytest.raises(SignatureInvalid, match="was changed"):
        verify_folder(folder, keys=trusted_keys(OURS.public_key))


def test_another_key_is_refused_though_it_signed_well(tmp_path: Path) -> None:
    publish(tmp_path / "model", THEIRS)
    KnownKeys().trust("https://ours", OURS.public_key)
    with pytest.raises(SigningKeyUntrusted, match=f"{THEIRS.key_id}, which is not known here: {OURS.key_id}"):
        verify_folder(tmp_path / "model", keys=trusted_keys(None))
    with pytest.raises(SigningKeyUntrusted, match=f"not the key that was given: {OURS.key_id}"):
        verify_folder(tmp_path / "model", keys=trusted_keys(OURS.public_key))


def test_another_key_under_our_id_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    publish(folder, THEIRS)
    forged = json.loads((folder / "manifest.sig.json").read_bytes()) | {"key_id": OURS.key_id}
    (folder / "manifest.sig.json").write_text(json.dumps(forged))
    with pytest.raises(SignatureInvalid, match="is not of"):
        verify_folder(folder, keys=trusted_keys(OURS.public_key))


def test_an_unsigned_model_is_loaded_only_on_request(tmp_path: Path) -> None:
    publish(tmp_path / "model", OURS)
    (tmp_path / "model" / "manifest.sig.json").unlink()
    with pytest.raises(SignatureInvalid, match="nobody signed"):
        verify_folder(tmp_path / "model", keys=trusted_keys(OURS.public_key))
    assert verify_folder(tmp_path / "model", keys=trusted_keys(None, allow_unsigned=True)).version == 2


@pytest.mark.parametrize(
    "text", ["", "[]", '{"key_id": "0", "signature": ""}', '{"key_id": "%s", "signature": "?"}']
)
def test_what_is_no_signature_is_refused(tmp_path: Path, text: str) -> None:
    publish(tmp_path / "model", OURS)
    (tmp_path / "model" / "manifest.sig.json").write_text(text.replace("%s", OURS.key_id))
    with pytest.raises(SignatureInvalid, match="is not an Ed25519 signature"):
        verify_folder(tmp_path / "model", keys=trusted_keys(OURS.public_key))
