"""The key that signs manifests of published models (Ed25519, RFC 8032), and the public keys that ever did.

The private key is, in this order:

    PHYSWORLD_SIGNING_KEY        base64 of its 32 bytes: a secret of the deployment, the same for every trainer
    PHYSWORLD_SIGNING_KEY_FILE   a file with that text
    {data_dir}/signing-key       the same, made at the first start with mode 0600

Whoever signs first enters the public key in the database, which is where clients learn it: someone who can write to
the object store alone can replace a model's files, but not their signature. A key that was replaced stays listed, so
that what it signed can still be verified.
"""

from __future__ import annotations

import base64
import hashlib
import os
import tempfile
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.base import Page
from physworld_schemas.signing import ManifestSignature, SigningKey
from physworld_storage.errors import ConfigurationError
from physworld_storage.pages import page_of
from physworld_storage.settings import Settings
from physworld_storage.tables import SigningKeyRow, insert_if_absent, utc_now

KEY_BYTES = 32
KEY_FILE = "signing-key"


@dataclass(frozen=True)
class Signer:
    """A private key and what is public of it."""

    key_id: str
    public_key: str
    _private: Ed25519PrivateKey = field(repr=False)

    def sign(self, manifest: bytes) -> bytes:
        """``manifest.sig.json`` for these bytes."""
        signature = base64.b64encode(self._private.sign(manifest)).decode()
        return ManifestSignature(key_id=self.key_id, signature=signature).model_dump_json(indent=1).encode()


def open_signer(settings: Settings) -> Signer:
    """The installation's signer; its key is made where there is none. Raises ConfigurationError."""
    if settings.signing_key is not None:
        return signer_of(settings.signing_key.get_secret_value(), "PHYSWORLD_SIGNING_KEY")
    if settings.signing_key_file is not None:
        return signer_of(_read(settings.signing_key_file), "PHYSWORLD_SIGNING_KEY_FILE")
    path = settings.data_dir / KEY_FILE
    if not path.exists():
        _make(path)
    return signer_of(_read(path), str(path))


def signer_of(text: str, place: str) -> Signer:
    """The signer of a private key in base64. Raises ConfigurationError naming ``place``, never the key."""
    try:
        seed = base64.b64decode(text.strip(), validate=True)
    except ValueError:
        seed = b""
    if len(seed) != KEY_BYTES:
        raise ConfigurationError([f"{place} holds no Ed25519 key: base64 of {KEY_BYTES} bytes is expected"])
    private = Ed25519PrivateKey.from_private_bytes(seed)
    public = private.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)
    return Signer(hashlib.sha256(public).hexdigest()[:16], base64.b64encode(public).decode(), private)


def register(session: Session, signer: Signer) -> None:
    """Enter the public key; the same key twice is one row."""
    values = {"key_id": signer.key_id, "public_key": signer.public_key, "created_at": utc_now()}
    insert_if_absent(session, SigningKeyRow, values)


def list_signing_keys(session: Session, *, limit: int = 50, cursor: str | None = None) -> Page[SigningKey]:
    """Public keys, newest first."""
    keys = (SigningKeyRow.created_at, SigningKeyRow.key_id)
    return page_of(session, select(SigningKeyRow), keys, _wire, limit=limit, cursor=cursor)


def _make(path: Path) -> None:
    """Write a new key, readable by its owner only; of two that start at once the first one's stays.

    Raises ConfigurationError where the folder takes no file or no link; no key is then left in it.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        # A name of its own for every thread: the link shares the file with it. mkstemp's mode is 0600.
        descriptor, part = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(base64.b64encode(os.urandom(KEY_BYTES)) + b"\n")
                file.flush()
                os.fsync(file.fileno())
            with suppress(FileExistsError):
                os.link(part, path)
        finally:
            Path(part).unlink()
    except OSError as error:
        raise ConfigurationError([f"the signing key {path} cannot be made: {error}"]) from error


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError([f"the signing key {path} cannot be read: {error}"]) from error


def _wire(row: SigningKeyRow) -> SigningKey:
    return SigningKey(key_id=row.key_id, public_key=row.public_key, created_at=row.created_at)
