"""Signatures of published models: Ed25519 over the bytes of a version's manifest."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from physworld_schemas.base import Resource

SIGNATURE_NAME = "manifest.sig.json"


class SigningKey(Resource):
    """A public key that signs, or signed, manifests of this service.

    ``public_key``: base64 of its 32 bytes (RFC 8032); ``key_id``: the first 16 hexadecimal digits of their SHA-256.
    """

    key_id: str = Field(
        pattern=r"^[0-9a-f]{16}$", description="First 16 hexadecimal digits of the key's SHA-256."
    )
    algorithm: Literal["ed25519"] = Field(default="ed25519", description="Algorithm.")
    public_key: str = Field(description="Public key, base64.")
    created_at: datetime | None = Field(default=None, description="When it was made, UTC.")


class ManifestSignature(Resource):
    """The content of ``manifest.sig.json``; ``signature``: base64 of 64 bytes over ``manifest.json`` as it is."""

    algorithm: Literal["ed25519"] = Field(default="ed25519", description="Algorithm.")
    key_id: str = Field(pattern=r"^[0-9a-f]{16}$", description="Key that signed.")
    signature: str = Field(description="64 bytes over manifest.json, base64.")
