"""The signing key: made once with mode 0600, taken from the environment in deployments, listed in the database."""

from __future__ import annotations

import base64
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from physworld_schemas.signing import ManifestSignature
from physworld_storage.database import Database
from physworld_storage.errors import ConfigurationError
from physworld_storage.settings import Settings
from physworld_storage.signing import list_signing_keys, open_signer, register

SEED = base64.b64encode(bytes(range(32))).decode()


def test_the_first_start_makes_a_private_key_that_stays(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "data")
    first = open_signer(settings)
    path = tmp_path / "data" / "signing-key"
    assert path.stat().st_mode & 0o777 == 0o600
    assert open_signer(settings).public_key == first.public_key
    assert path.read_text().strip() not in repr(first)
    assert [file.name for file in (tmp_path / "data").iterdir()] == ["signing-key"]


def test_trainers_that_start_at_once_share_one_key(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    with ThreadPoolExecutor(8) as pool:
        keys = {signer.key_id for signer in pool.map(lambda _: open_signer(settings), range(8))}
    assert len(keys) == 1


def test_a_deployment_brings_its_own_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PHYSWORLD_SIGNING_KEY", SEED)
    monkeypatch.setenv("PHYSWORLD_DATA_DIR", str(tmp_path))
    from_variable = open_signer(Settings())
    monkeypatch.delenv("PHYSWORLD_SIGNING_KEY")
    (tmp_path / "secret").write_text(SEED + "\n")
    monkeypatch.setenv("PHYSWORLD_SIGNING_KEY_FILE", str(tmp_path / "secret"))
    assert open_signer(Settings()).key_id == from_variable.key_id
    assert not (tmp_path / "signing-key").exists()


@pytest.mark.parametrize("text", ["", "short", "ä", base64.b64encode(bytes(31)).decode()])
def test_what_is_no_key_is_named_without_showing_it(tmp_path: Path, text: str) -> None:
    (tmp_path / "secret").write_text(text)
    settings = Settings(data_dir=tmp_path, signing_key_file=tmp_path / "secret")
    with pytest.raises(ConfigurationError, match="PHYSWORLD_SIGNING_KEY_FILE holds no Ed25519 key") as caught:
        open_signer(settings)
    assert not text or text not in str(caught.value)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        open_signer(Settings(data_dir=tmp_path, signing_key_file=tmp_path / "absent"))


def test_a_folder_that_takes_no_key_is_named_and_keeps_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(ConfigurationError, match="signing-key cannot be made"):
        open_signer(Settings(data_dir=tmp_path / "file"))

    def without_links(source: str, target: Path) -> None:
        raise PermissionError(1, "Operation not permitted", source)  # as FAT and some network folders answer

    monkeypatch.setattr("os.link", without_links)
    with pytest.raises(ConfigurationError, match="Operation not permitted"):
        open_signer(Settings(data_dir=tmp_path / "data"))
    assert list((tmp_path / "data").iterdir()) == []


def test_signatures_are_of_the_exact_bytes(tmp_path: Path) -> None:
    signer = open_signer(Settings(data_dir=tmp_path))
    signature = ManifestSignature.model_validate_json(signer.sign(b"manifest"))
    public = Ed25519PublicKey.from_public_bytes(base64.b64decode(signer.public_key))
    public.verify(base64.b64decode(signature.signature), b"manifest")
    with pytest.raises(InvalidSignature):
        public.verify(base64.b64decode(signature.signature), b"manifesT")


def test_public_keys_are_listed_and_those_replaced_stay(database: Database, tmp_path: Path) -> None:
    signers = [open_signer(Settings(data_dir=tmp_path / name)) for name in ("old", "new", "new")]
    for signer in signers:
        with database.session() as session:
            register(session, signer)
    with database.reading() as session:
        found = {key.key_id: key.public_key for key in list_signing_keys(session).data}
    assert found == {signer.key_id: signer.public_key for signer in signers[:2]}
