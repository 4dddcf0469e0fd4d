"""Signatures of published models: who signed a manifest, and whether that key is known here.

A manifest is signed with Ed25519 by the service that published it (``manifest.sig.json``). The public key is trusted

* when it is given (``public_key=``), or
* when it is in the file of known keys, which every ``client.models.download`` adds the keys to that its service lists:
  ``PHYSWORLD_KNOWN_KEYS``, else ``physworld/known-keys.json`` below ``XDG_CONFIG_HOME`` or ``~/.config``.

A key that lies beside the files would prove nothing: whoever can replace a manifest can replace that too.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from pydantic import ValidationError

from physworld_client.errors import ModelUnreadable, SignatureInvalid
from schemas.signing import SIGNATURE_NAME, ManifestSignature, SigningKey

KEY_BYTES = 32


def verify_signature(folder: Path, manifest: bytes, keys: Mapping[str, str]) -> str:
    """Checks ``manifest.sig.json`` of a folder against the manifest's bytes; the id of the key that signed.

    Args:
        keys: public keys in base64 by key id.

    Raises:
        SignatureInvalid: there is no signature, its key is not among ``keys``, or it is not of these bytes.
    """
    path = folder / SIGNATURE_NAME
    if not path.is_file():
        raise SignatureInvalid(f"{folder} holds no {SIGNATURE_NAME}: nobody signed its manifest")
    try:
        signature = ManifestSignature.model_validate_json(path.read_bytes())
        raw = base64.b64decode(signature.signature, validate=True)
    except (ValidationError, ValueError) as error:
        raise SignatureInvalid(f"{path} is not an Ed25519 signature: {error}") from error
    if signature.key_id not in keys:
        known = ", ".join(sorted(keys)) or "none"
        raise SignatureInvalid(
            f"{path} was signed by key {signature.key_id}, which is not known here (known: {known})"
        )
    try:
        public_key(keys[signature.key_id]).verify(raw, manifest)
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
            f"{text[:60]!r} is no Ed25519 public key: base64 of {KEY_BYTES} bytes is expected"
        )
    return Ed25519PublicKey.from_public_bytes(raw)


def keys_by_id(texts: Iterable[str]) -> dict[str, str]:
    """Public keys by their ids. Raises ModelUnreadable for a text that is none."""
    return {
        hashlib.sha256(public_key(text).public_bytes_raw()).hexdigest()[:16]: text.strip() for text in texts
    }


def trusted_keys(public_key: str | None, allow_unsigned: bool = False) -> dict[str, str] | None:
    """The keys that may have signed: the one given, else all known ones; None: the signature does not matter."""
    if allow_unsigned:
        return None
    return known_keys() if public_key is None else keys_by_id([public_key])


def known_keys() -> dict[str, str]:
    """Keys that were met before, by id. Raises ModelUnreadable when the file is damaged."""
    path = known_keys_file()
    if not path.is_file():
        return {}
    try:
        held = json.loads(path.read_bytes())
        return {key_id: held[key_id]["public_key"] for key_id in held}
    except (ValueError, KeyError, TypeError) as error:
        raise ModelUnreadable(f"{path} is not a file of known keys: {error!r}") from error


def remember(keys: Iterable[SigningKey], origin: str) -> dict[str, str]:
    """Adds a service's keys to the known ones; what is known stays. All known keys by id.

    Raises:
        SignatureInvalid: a key id stands for another key than before.
    """
    path = known_keys_file()
    known = known_keys()
    held = json.loads(path.read_bytes()) if path.is_file() else {}
    for key in keys:
        if key.key_id not in keys_by_id([key.public_key]):
            raise SignatureInvalid(f"{origin} names a key {key.key_id} whose bytes have another id")
        if key.key_id not in known:
            held[key.key_id] = {"public_key": key.public_key, "origin": origin}
    if held.keys() != known.keys():
        _write(path, json.dumps(held, indent=1) + "\n")
    return {key_id: entry["public_key"] for key_id, entry in held.items()}


def _write(path: Path, text: str) -> None:
    """Replace the file in one step."""
    part = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text)
        part.replace(path)
    except OSError as error:
        raise ModelUnreadable(
            f"the service's keys cannot be remembered in {path} ({error}): set PHYSWORLD_KNOWN_KEYS to a place "
            "that can be written, or give public_key"
        ) from error
    finally:
        with suppress(OSError):
            part.unlink()


def known_keys_file() -> Path:
    """Where known keys are kept."""
    given = os.environ.get("PHYSWORLD_KNOWN_KEYS")
    if given:
        return Path(given)
    return (
        Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "physworld" / "known-keys.json"
    )
