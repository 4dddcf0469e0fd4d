"""Signatures of published models: who signed a manifest, and whether that key is trusted here.

A manifest is signed with Ed25519 by the service that published it (``manifest.sig.json``). A public key is trusted

* when it is given (``public_key=``), or
* when it is pinned on this machine (``physworld_client.known_keys``): for the service that a download comes from, for
  any service when a folder is opened without one.

A key that lies beside the files would prove nothing: whoever can replace a manifest can replace that too. A key's
fingerprint is the SHA-256 of its 32 bytes in hexadecimal; a signature names the first 16 digits of it (key id).
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from pydantic import ValidationError

from physworld_client.errors import ModelUnreadable, SignatureInvalid, SigningKeyUntrusted
from physworld_schemas.signing import SIGNATURE_NAME, ManifestSignature, SigningKey

KEY_BYTES = 32
LONGEST_KEY_FILE = 4096


@dataclass(frozen=True)
class TrustedKeys:
    """Public keys in base64 by key id.

    Attributes:
        by_id: those that may have signed.
        whose: how the error for another key calls them: "trusted for https://…".
        service: where the files come from; None for a folder that is opened without a service.
        listed: keys that the service lists, trusted or not.
    """

    by_id: Mapping[str, str]
    whose: str
    service: str | None = None
    listed: Mapping[str, str] = field(default_factory=dict)


def verify_signature(folder: Path, manifest: bytes, keys: TrustedKeys) -> str:
    """Checks ``manifest.sig.json`` of a folder against the manifest's bytes; the id of the key that signed.

    Raises:
        SigningKeyUntrusted: its key is not among ``keys``.
        SignatureInvalid: there is no signature, or it is not of these bytes.
    """
    path = folder / SIGNATURE_NAME
    if not path.is_file():
        raise SignatureInvalid(f"{folder} holds no {SIGNATURE_NAME}: nobody signed its manifest")
    try:
        signature = ManifestSignature.model_validate_json(path.read_bytes())
        raw = base64.b64decode(signature.signature, validate=True)
    except (ValidationError, ValueError) as error:
        raise SignatureInvalid(f"{path} is not an Ed25519 signature: {error}") from error
    if signature.key_id not in keys.by_id:
        raise _untrusted(path, signature.key_id, keys)
    try:
        public_key(keys.by_id[signature.key_id]).verify(raw, manifest)
    except InvalidSignature:
        raise SignatureInvalid(
            f"{path}: the signature by key {signature.key_id} is not of {folder / 'manifest.json'} as it is here "
            f"(sha256 {hashlib.sha256(manifest).hexdigest()}): one of the two was changed"
        ) from None
    return signature.key_id


def public_key(text: str) -> Ed25519PublicKey:
    """The key of a base64 text. Raises ModelUnreadable."""
    try:
        raw = base64.b64decode(text.strip(), validate=True)
    except ValueError:
        raw = b""
    if len(raw) != KEY_BYTES:
        raise ModelUnreadable(
            f"{text[:80]!r} is no Ed25519 public key: base64 of {KEY_BYTES} bytes is expected"
        )
    return Ed25519PublicKey.from_public_bytes(raw)


def fingerprint_of(text: str) -> str:
    """SHA-256 of a public key in base64, 64 hexadecimal digits. Raises ModelUnreadable for a text that is none."""
    return hashlib.sha256(public_key(text).public_bytes_raw()).hexdigest()


def keys_by_id(texts: Iterable[str]) -> dict[str, str]:
    """Public keys by their ids. Raises ModelUnreadable for a text that is none."""
    return {fingerprint_of(text)[:16]: text.strip() for text in texts}


def given_key(key: str | Path) -> str:
    """A key as it was given: a text, or the content of a file at a ``Path``. Raises ModelUnreadable."""
    if isinstance(key, str):
        return key.strip()
    try:
        with key.open("rb") as stream:
            return stream.read(LONGEST_KEY_FILE).decode().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ModelUnreadable(f"{key} is no file with a public key: {error}") from error


def listed_keys(keys: Iterable[SigningKey], service: str) -> dict[str, str]:
    """What a service lists, by id. Raises SignatureInvalid where an id is not that of its key."""
    found = {}
    for key in keys:
        if key.key_id not in keys_by_id([key.public_key]):
            raise SignatureInvalid(f"{service} names a key {key.key_id} whose bytes have another id")
        found[key.key_id] = key.public_key
    return found


def _untrusted(path: Path, key_id: str, keys: TrustedKeys) -> SigningKeyUntrusted:
    """The error for a signature by another key, with both fingerprints and what to do."""
    trusted = tuple(sorted(fingerprint_of(text) for text in keys.by_id.values()))
    signer = fingerprint_of(keys.listed[key_id]) if key_id in keys.listed else None
    text = f"{path} was signed by key {signer or key_id}, which is not {keys.whose}: {', '.join(trusted) or 'none'}. "
    if keys.service is None:
        text += "Give the key as public_key, or download the model from its service"
    elif signer is None:
        text += f"{keys.service} does not list that key either: nobody there signed these files"
    else:
        text += (
            "Somebody replaced the key or the model. If the operator of the service confirms this fingerprint, accept "
            f"it with `physworld models trust {signer}` or client.models.trust"
        )
    return SigningKeyUntrusted(text, keys.service, signer or key_id, trusted)
