"""Settings come from the environment; what cannot work is named."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from physworld_storage.errors import ConfigurationError
from physworld_storage.settings import Settings


@pytest.fixture(autouse=True)
def bare_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in os.environ:
        if name.startswith("PHYSWORLD_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))


def test_everything_lies_below_the_data_directory(tmp_path: Path) -> None:
    settings = Settings()
    assert settings.data_dir == tmp_path / ".local/share/physworld"
    assert settings.database_url == f"sqlite:///{settings.data_dir}/physworld.db"
    assert settings.store_url == f"file://{settings.data_dir}/store"
    assert settings.store_folder == settings.data_dir / "store"


def test_a_folder_with_spaces_keeps_its_name(tmp_path: Path) -> None:
    folder = tmp_path / "my data %41"
    assert Settings(data_dir=folder).store_folder == folder / "store"


def test_the_environment_moves_it_to_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {
        "DATABASE_URL": "postgresql://user:word@db/physworld",
        "BROKER_URL": "redis://:word@broker:6379/0",
        "STORE_URL": "s3://bucket/prefix",
        "S3_ENDPOINT": "http://store:9000",
        "S3_ACCESS_KEY_ID": "id",
        "S3_SECRET_ACCESS_KEY": "word",
        "LEASE_SECONDS": "12.5",
        "DATA_DIR": "",
    }.items():
        monkeypatch.setenv(f"PHYSWORLD_{name}", value)
    settings = Settings()
    settings.check()
    assert settings.lease_seconds == 12.5
    assert settings.store_folder is None
    assert "word" not in repr(settings)


def test_what_is_missing_is_named() -> None:
    with pytest.raises(ConfigurationError, match="PHYSWORLD_BROKER_URL is not set") as raised:
        Settings().check()
    assert len(raised.value.faults) == 1
    Settings().check(broker=False)


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ({"database_url": "mysql://x"}, "PHYSWORLD_DATABASE_URL has scheme 'mysql'"),
        ({"store_url": "ftp://x"}, "PHYSWORLD_STORE_URL has scheme 'ftp'"),
        ({"store_url": "s3:///prefix"}, "names no bucket"),
        ({"store_url": "file://relative/path"}, "is not file:///absolute/folder"),
        ({"store_url": "s3://b", "s3_access_key_id": "x"}, "PHYSWORLD_S3_SECRET_ACCESS_KEY is not set"),
        ({"store_url": "s3://b", "s3_secret_access_key": "x"}, "PHYSWORLD_S3_ACCESS_KEY_ID is not set"),
        ({"broker_url": "amqp://x"}, "PHYSWORLD_BROKER_URL has scheme 'amqp'"),
    ],
)
def test_what_cannot_work_is_named(given: dict[str, str], fault: str) -> None:
    with pytest.raises(ConfigurationError, match=fault):
        Settings.model_validate({"broker_url": "redis://x", **given}).check()
