"""The manifest of a published model: which files belong to it, with size and SHA-256 of each.

``manifest.json`` is ``{"name", "version", "files": {name: {"sha256", "size"}}}``; a version's ``sha256`` is
the digest of this file. ``manifest.sig.json`` signs it (``physworld_client.signatures``). Nothing of a model is read
before its files and the signature were verified.
"""

from __future__ import annotations

import hashlib
from pathlib import Path, PurePosixPath

from pydantic import BaseModel, ValidationError

from physworld_client.errors import DigestMismatch, ModelUnreadable
from physworld_client.partial import sha256_of
from physworld_client.signatures import TrustedKeys, verify_signature
from physworld_schemas.base import Artifact
from physworld_schemas.model import ModelVersion

MANIFEST_NAME = "manifest.json"
WEIGHTS_NAME = "model.safetensors"
CARD_NAME = "card.json"


class ManifestFile(BaseModel):
    """Digest and size [bytes] of one file."""

    sha256: str
    size: int


class Manifest(BaseModel):
    """The content of ``manifest.json``."""

    name: str
    version: int
    files: dict[str, ManifestFile]


def verify_folder(folder: Path, sha256: str | None = None, *, keys: TrustedKeys | None = None) -> Manifest:
    """Checks the signature of a model folder's manifest, the manifest against ``sha256``, every file against it.

    Args:
        keys: those that may have signed; None leaves the signature unchecked.

    Raises:
        SignatureInvalid: no key of ``keys`` signed this manifest.
        ModelUnreadable: the manifest or a file is missing, or a name leaves the folder.
        DigestMismatch: a file, or the manifest, is not what was published.
    """
    path = folder / MANIFEST_NAME
    if not path.is_file():
        raise ModelUnreadable(f"{folder} holds no {MANIFEST_NAME}: not a downloaded model")
    data = path.read_bytes()
    if sha256 is not None and (found := hashlib.sha256(data).hexdigest()) != sha256:
        raise DigestMismatch(str(path), sha256, found)
    if keys is not None:
        verify_signature(folder, data, keys)
    try:
        manifest = Manifest.model_validate_json(data)
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(str(part) for part in fault["loc"])
        raise ModelUnreadable(f"{path} is not a manifest: {place}: {fault['msg']}") from error
    for name, entry in manifest.files.items():
        file = folder / checked_name(name)
        if not file.is_file():
            raise ModelUnreadable(f"{folder} lacks {name}, which its manifest lists")
        size = file.stat().st_size
        if size != entry.size:
            raise DigestMismatch(
                f"{file} ({size} bytes, expected {entry.size})", entry.sha256, sha256_of(file)
            )
        if (found := sha256_of(file)) != entry.sha256:
            raise DigestMismatch(str(file), entry.sha256, found)
    return manifest


def artifacts_of(version: ModelVersion) -> list[Artifact]:
    """The files of a published version, the manifest among them.

    Raises:
        ModelUnreadable: the version is not ready, has no manifest, or names a file outside its folder.
    """
    label = f"{version.name} version {version.version}"
    if version.state != "ready":
        reason = f": {version.message}" if version.message else ""
        raise ModelUnreadable(f"{label} is {version.state}{reason}")
    manifest = [artifact for artifact in version.artifacts if artifact.name == MANIFEST_NAME]
    if not manifest or version.sha256 is None:
        names = ", ".join(artifact.name for artifact in version.artifacts) or "nothing"
        raise ModelUnreadable(f"{label} has no {MANIFEST_NAME} (it has {names})")
    for artifact in version.artifacts:
        checked_name(artifact.name)
    return version.artifacts


def checked_name(name: str) -> str:
    """The name, when it stays inside the folder it is put in.

    Raises:
        ModelUnreadable: it is absolute, climbs, or is empty.
    """
    path = PurePosixPath(name)
    if path.is_absolute() or not path.parts or ".." in path.parts or "\\" in name or "\0" in name:
        raise ModelUnreadable(f"the file name {name!r} leaves its folder")
    return name
