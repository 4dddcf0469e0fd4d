"""Settings of every process, from environment variables ``PHYSWORLD_*``; nothing secret has a default.

Embedded and distributed differ here and nowhere else::

    PHYSWORLD_DATA_DIR       folder of the embedded service            ~/.local/share/physworld
    PHYSWORLD_DATABASE_URL   sqlite:///… or postgresql://…             sqlite:///{data_dir}/physworld.db
    PHYSWORLD_BROKER_URL     redis://:password@host:port/0             none (the embedded service sets it)
    PHYSWORLD_BROKER_PREFIX  of every key in a broker that is shared    none
    PHYSWORLD_STORE_URL      file:///folder or s3://bucket/prefix      file://{data_dir}/store
    PHYSWORLD_INFERENCE_URL  http://host:port of the inference service   none (the embedded service sets it)
    PHYSWORLD_DEVICE         of simulations and training: cpu, cuda:0   cpu
    PHYSWORLD_TRUSTED_PROXIES  whose word on client and scheme counts     none
    PHYSWORLD_SIGNING_KEY    base64 of an Ed25519 key (32 bytes)        made in data_dir (``physworld_storage.signing``)
    PHYSWORLD_SIGNING_KEY_FILE  a file that holds it                    none
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Literal
from urllib.parse import unquote, urlsplit

from pydantic import Field, SecretStr, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from physworld_storage.errors import ConfigurationError

DATABASE_SCHEMES = ("sqlite", "postgresql", "postgres", "postgresql+psycopg")
STORE_SCHEMES = ("file", "s3")
BROKER_SCHEMES = ("redis", "rediss")


class Settings(BaseSettings):
    """One frozen set of settings; build it with keyword arguments in tests."""

    model_config = SettingsConfigDict(env_prefix="PHYSWORLD_", extra="ignore", frozen=True)

    data_dir: Path = Field(default_factory=lambda: Path.home() / ".local" / "share" / "physworld")
    database_url: str = Field(default="", repr=False)
    broker_url: SecretStr | None = None
    broker_prefix: str = ""
    store_url: str = ""
    s3_endpoint: str | None = None
    s3_access_key_id: str | None = None
    s3_secret_access_key: SecretStr | None = None
    s3_region: str = "us-east-1"
    lease_seconds: float = Field(default=30.0, gt=0)
    max_attempts: int = Field(default=5, ge=1)
    republish_seconds: float = Field(default=60.0, gt=0)
    orphan_seconds: float = Field(default=86400.0, ge=60.0)
    max_upload_bytes: int = Field(default=512 * 2**20, ge=1)
    signing_key: SecretStr | None = None
    signing_key_file: Path | None = None
    trusted_proxies: str = Field(default="", pattern=r"^[0-9A-Fa-f.:/, ]*$")
    inference_url: str = Field(default="", pattern=r"^(https?://[^/\s]+)?$")
    device: str = Field(default="cpu", pattern=r"^(cpu|cuda:\d+)$")
    log_level: Literal["debug", "info", "warning", "error"] = "info"

    @model_validator(mode="before")
    @classmethod
    def _blank_is_unset(cls, values: dict[str, object]) -> dict[str, object]:
        """A variable set to the empty string (``${X:-}`` in a compose file) counts as not set."""
        return {name: value for name, value in values.items() if value != ""}

    @model_validator(mode="after")
    def _places_below_data_dir(self) -> Settings:
        folder = self.data_dir.expanduser().absolute()
        places = {
            "data_dir": folder,
            "database_url": self.database_url or f"sqlite:///{folder / 'physworld.db'}",
            "store_url": self.store_url or (folder / "store").as_uri(),
        }
        for name, value in places.items():
            object.__setattr__(self, name, value)
        return self

    def check(self, *, broker: bool = True) -> None:
        """Raise ConfigurationError naming everything that is missing or cannot work.

        ``broker=False`` for a process that never talks to the broker (the web process, the migration).
        """
        faults = []
        database = urlsplit(self.database_url).scheme
        if database not in DATABASE_SCHEMES:
            faults.append(f"PHYSWORLD_DATABASE_URL has scheme {database!r}; known: sqlite, postgresql")
        if broker and self.broker_url is None:
            faults.append("PHYSWORLD_BROKER_URL is not set (redis://:password@host:port/0)")
        if broker and self.broker_url is not None:
            scheme = urlsplit(self.broker_url.get_secret_value()).scheme
            if scheme not in BROKER_SCHEMES:
                known = ", ".join(BROKER_SCHEMES)
                faults.append(f"PHYSWORLD_BROKER_URL has scheme {scheme!r}; known: {known}")
        faults.extend(self._store_faults())
        if faults:
            raise ConfigurationError(faults)

    def _store_faults(self) -> list[str]:
        url = urlsplit(self.store_url)
        if url.scheme not in STORE_SCHEMES:
            return [f"PHYSWORLD_STORE_URL has scheme {url.scheme!r}; known: {', '.join(STORE_SCHEMES)}"]
        if url.scheme == "file":
            if url.netloc or not url.path.startswith("/"):
                return [f"PHYSWORLD_STORE_URL {self.store_url!r} is not file:///absolute/folder"]
            return []
        faults = [] if url.netloc else ["PHYSWORLD_STORE_URL names no bucket (s3://bucket/prefix)"]
        if self.s3_access_key_id and self.s3_secret_access_key is None:
            faults.append("PHYSWORLD_S3_SECRET_ACCESS_KEY is not set, PHYSWORLD_S3_ACCESS_KEY_ID is")
        if self.s3_secret_access_key is not None and not self.s3_access_key_id:
            faults.append("PHYSWORLD_S3_ACCESS_KEY_ID is not set, PHYSWORLD_S3_SECRET_ACCESS_KEY is")
        return faults

    @property
    def store_folder(self) -> Path | None:
        """The local folder of the store, or None where it is a bucket."""
        url = urlsplit(self.store_url)
        return Path(unquote(url.path)) if url.scheme == "file" else None


@lru_cache(maxsize=1)
def get_settings() -> Settings:
    """The settings of this process, read once from the environment."""
    return Settings()
