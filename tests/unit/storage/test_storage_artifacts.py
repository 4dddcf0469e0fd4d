"""Content-addressed files, in a folder and in a bucket over real HTTP."""

from __future__ import annotations

import hashlib
import socket
from pathlib import Path

import obstore
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import SecretStr

from physworld_storage.artifacts import ArtifactStore
from physworld_storage.errors import ArtifactCorrupt, NotFound, StoreReadFailed, StoreWriteFailed
from physworld_storage.settings import Settings

BIG_BYTES = 7_000_001  # more than one part of a multipart upload, and no round number


@pytest.fixture
def artifacts(store_settings: Settings) -> ArtifactStore:
    return ArtifactStore(store_settings)


def test_what_was_put_is_read_again(artifacts: ArtifactStore) -> None:
    artifact = artifacts.put_bytes(b"hello", "greeting.txt", "text/plain")
    assert artifact.sha256 == hashlib.sha256(b"hello").hexdigest()
    assert (artifact.name, artifact.size, artifact.media_type) == ("greeting.txt", 5, "text/plain")
    assert artifacts.read_bytes(artifact.sha256) == b"hello"
    assert artifacts.exists(artifact.sha256)
    assert artifacts.size(artifact.sha256) == 5


def test_an_empty_file_is_a_file(artifacts: ArtifactStore) -> None:
    artifact = artifacts.put_bytes(b"", "empty")
    assert artifacts.read_bytes(artifact.sha256) == b""
    assert artifacts.exists(artifact.sha256)


def test_a_big_file_comes_back_in_pieces(artifacts: ArtifactStore, tmp_path: Path) -> None:
    path = tmp_path / "big.bin"
    data = bytes(range(256)) * (BIG_BYTES // 256) + b"end"
    path.write_bytes(data)
    artifact = artifacts.put_file(path)
    assert (artifact.name, artifact.size) == ("big.bin", len(data))
    pieces = list(artifacts.open(artifact.sha256))
    assert len(pieces) > 1
    assert b"".join(pieces) == data
    assert artifacts.put_file(path, "again.bin").sha256 == artifact.sha256


@pytest.mark.parametrize("rotten", [b"HELLO, world", b"hello", b""])
def test_a_file_that_has_rotted_is_replaced_by_the_next_write(
    artifacts: ArtifactStore, tmp_path: Path, rotten: bytes
) -> None:
    data = b"hello, world"
    sha256 = artifacts.put_bytes(data, "greeting.txt").sha256
    for again in (lambda: artifacts.put_bytes(data, "again"), lambda: artifacts.put_file(tmp_path / "file")):
        (tmp_path / "file").write_bytes(data)
        obstore.put(artifacts._store, f"artifacts/{sha256[:2]}/{sha256}", rotten)
        with pytest.raises(ArtifactCorrupt):
            artifacts.read_bytes(sha256)
        assert again().sha256 == sha256
        assert artifacts.read_bytes(sha256) == data


def test_a_range_is_what_lies_between(artifacts: ArtifactStore) -> None:
    artifact = artifacts.put_bytes(b"0123456789", "digits")
    assert b"".join(artifacts.open(artifact.sha256, 2, 5)) == b"234"
    assert b"".join(artifacts.open(artifact.sha256, 7)) == b"789"
    assert b"".join(artifacts.open(artifact.sha256, 7, 99)) == b"789"
    assert b"".join(artifacts.open(artifact.sha256, 10)) == b""
    with pytest.raises(ValueError, match="range 11 to 10 does not lie in 10 bytes"):
        artifacts.open(artifact.sha256, 11)


@pytest.mark.parametrize("name", ["f" * 64, "../../etc/passwd", "", "F" * 64, "0" * 63])
def test_what_is_not_there_is_not_found(artifacts: ArtifactStore, name: str) -> None:
    assert not artifacts.exists(name)
    with pytest.raises(NotFound):
        artifacts.open(name)
    with pytest.raises(NotFound):
        artifacts.read_bytes(name)


@given(data=st.binary(max_size=300), cut=st.tuples(st.integers(0, 300), st.integers(0, 300)))
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_every_range_of_every_file(tmp_path: Path, data: bytes, cut: tuple[int, int]) -> None:
    artifacts = ArtifactStore(Settings(data_dir=tmp_path))
    start, end = sorted(min(place, len(data)) for place in cut)
    artifact = artifacts.put_bytes(data, "data")
    assert b"".join(artifacts.open(artifact.sha256, start, end)) == data[start:end]


def test_changed_bytes_are_noticed(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    artifacts = ArtifactStore(settings)
    artifact = artifacts.put_bytes(b"truth", "fact")
    assert settings.store_folder is not None
    path = settings.store_folder / "artifacts" / artifact.sha256[:2] / artifact.sha256
    path.write_bytes(b"trust")
    with pytest.raises(ArtifactCorrupt, match=artifact.sha256):
        artifacts.read_bytes(artifact.sha256)


def test_a_file_that_was_cut_to_nothing_is_noticed(tmp_path: Path) -> None:
    """What a power failure leaves of a file that was not yet on the disk."""
    settings = Settings(data_dir=tmp_path)
    artifacts = ArtifactStore(settings)
    artifact = artifacts.put_bytes(b"truth", "fact")
    assert settings.store_folder is not None
    (settings.store_folder / "artifacts" / artifact.sha256[:2] / artifact.sha256).write_bytes(b"")
    with pytest.raises(ArtifactCorrupt, match=artifact.sha256):
        artifacts.read_bytes(artifact.sha256)


def test_a_file_that_was_cut_short_is_written_again(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    artifacts = ArtifactStore(settings)
    artifact = artifacts.put_bytes(b"truth", "fact")
    assert settings.store_folder is not None
    (settings.store_folder / "artifacts" / artifact.sha256[:2] / artifact.sha256).write_bytes(b"")
    artifacts.put_bytes(b"truth", "fact")
    assert artifacts.read_bytes(artifact.sha256) == b"truth"


def test_a_folder_that_cannot_be_made_is_said_plainly(tmp_path: Path) -> None:
    (tmp_path / "store").write_text("a file where the folder should be")
    with pytest.raises(StoreWriteFailed, match="was not written"):
        ArtifactStore(Settings(data_dir=tmp_path))


def test_a_bucket_that_is_not_there_is_said_plainly(s3_endpoint: str, tmp_path: Path) -> None:
    artifacts = ArtifactStore(
        Settings(
            data_dir=tmp_path,
            store_url="s3://no-such-bucket/x",
            s3_endpoint=s3_endpoint,
            s3_access_key_id="id",
            s3_secret_access_key=SecretStr("secret"),
        )
    )
    with pytest.raises(StoreWriteFailed, match="artifact a, 1 bytes, was not written to s3://no-such-bucket"):
        artifacts.put_bytes(b"x", "a")


def test_a_server_that_is_away_is_not_a_missing_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("physworld_storage.store.MAX_RETRIES", 0)
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    artifacts = ArtifactStore(
        Settings(
            data_dir=tmp_path,
            store_url="s3://bucket",
            s3_endpoint=f"http://127.0.0.1:{port}",
            s3_access_key_id="id",
            s3_secret_access_key=SecretStr("secret"),
        )
    )
    with pytest.raises(StoreReadFailed):
        artifacts.exists("0" * 64)
