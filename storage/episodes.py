"""The episode store: one file for each attempt at an episode, a zarr group with one shard for each of its arrays.

``datasets/{dataset}/episodes/{index}-e{epoch}.zarr.zip`` belongs to one lease (``epoch`` is its fencing token),
so no two writers ever share a file. An episode exists once the database has committed
its path and digest; anything else below ``episodes/`` is an orphan of a dead attempt. A sealed dataset is its
manifest: an artifact that lists (path, digest) of every episode.

Arrays (T frames, P particles, K controllers): ``times`` (T,) f8 [s]; ``particles`` (T, P, 3) f4 [m];
``controllers`` (T, K, 3) f4 [m]; ``properties`` (P, 2 or 3) f4, log(E/E_fit), log(rho/rho_fit) and, where the
ground's friction is perturbed, log(mu/mu_fit); ``vertices`` (T, M, 3) f4 [m] and ``vertex_index`` (M,) i4: some of
the particles again, those that a world model takes for its vertices, so that a training need not read the others;
where grips let go ``holding`` (T, G) u1: whether each of the G grips holds from that frame to the next.
Chunks lie along the first axis inside a shard. Datasets made before ADR 33 hold a folder ``….zarr`` for each episode,
with a file for each array and each header; they are read as ever.

The digest of an episode is over the digests of its arrays, so that a part can be read and verified alone. Episodes of
the first format have one digest over all bytes and are read whole. Attributes are no part of it, so that episodes made
again from another upload of the same scene keep theirs; they stand beside a digest of their own.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np
import obstore
from numpy.typing import NDArray
from obstore.exceptions import NotFoundError
from pydantic import ValidationError

from physworld_schemas.base import Artifact, Resource
from physworld_schemas.dataset import Episode
from physworld_schemas.wording import reason
from physworld_storage.artifacts import ArtifactStore
from physworld_storage.errors import EpisodeCorrupt, NotFound
from physworld_storage.patience import WORKING, Patience
from physworld_storage.settings import Settings
from physworld_storage.store import open_store, reading, writing

if TYPE_CHECKING:
    import zarr

Arrays = dict[str, NDArray[Any]]

FORMAT, FIRST_FORMAT = "physworld-episode/2", "physworld-episode/1"
ATTRIBUTES_DIGEST = "attributes_sha256"
MANIFEST_NAME = "manifest.json"
MANIFEST_TYPE = "application/json"
DATASET_ID = re.compile(r"[A-Za-z0-9_-]+")
EPISODE_PATH = re.compile(r"datasets/[A-Za-z0-9_-]+/episodes/[0-9]{5,}-e[0-9]+\.zarr(\.zip)?")
FILE = ".zip"
"""What the path of an episode in one file ends with; older ones are folders."""


class ManifestEpisode(Resource):
    """One line of a manifest."""

    index: int
    path: str
    digest: str
    seed: int
    frames: int
    particles: int
    motion: str = ""


class Manifest(Resource):
    """A sealed dataset: its episodes in the order of their index."""

    schema_version: int = 1
    dataset_id: str
    episodes: list[ManifestEpisode]


class EpisodeStore:
    """Episodes in a local folder or a bucket."""

    def __init__(self, settings: Settings, patience: Patience = WORKING) -> None:
        self._settings = settings
        self._store = open_store(settings, patience=patience)
        self._uploads = open_store(settings, patience=patience, uploads=True)
        self._patience = patience
        self._artifacts = ArtifactStore(settings, patience)

    def write(
        self,
        dataset_id: str,
        index: int,
        epoch: int,
        arrays: Mapping[str, NDArray[Any]],
        attributes: Mapping[str, Any],
    ) -> tuple[str, str]:
        """Write one attempt at an episode, at once; its path and the digest of its arrays.

        Args:
            dataset_id: the dataset that it belongs to.
            index: of the episode in the dataset.
            epoch: of the lease under which it is written; another attempt has another path.
            arrays: by name, with time as their first axis where they have one.
            attributes: what is noted beside them, as JSON.

        Raises:
            StoreWriteFailed: the store did not take it; nothing of it is then there.
            StoreFull: there is no room; nothing of it is then there.
        """
        from physworld_storage.episode_files import (
            packed,  # zarr takes as long to import as the API's own routes
        )

        path = episode_path(dataset_id, index, epoch)
        plain = {name: _plain(name, array) for name, array in arrays.items()}
        size = sum(array.nbytes for array in plain.values())
        parts = {name: _part(array) for name, array in plain.items()}
        noted = dict(attributes)
        header = {
            "format": FORMAT,
            "arrays": parts,
            "attributes": noted,
            ATTRIBUTES_DIGEST: _digest_of_json(noted),
        }
        content = packed(header, plain)
        with writing(f"episode {path}", size, self._settings):
            obstore.put(self._uploads, path, content)
        return path, _digest_of(parts)

    def read(
        self, path: str, digest: str | None = None, names: Collection[str] | None = None
    ) -> tuple[Arrays, dict[str, Any]]:
        """Arrays and attributes of an episode, checked against ``digest`` where it is given.

        ``names``: the arrays to read, those of them that there are; all without it.

        Raises NotFound, or EpisodeCorrupt when it cannot be decoded or is not what was committed.
        """
        if not EPISODE_PATH.fullmatch(path):
            raise NotFound("episode", path[:200])
        with _decoding(path), reading("episode", path, self._settings):
            group = self._group(path)
            header = dict(group.attrs)
        with _decoding(path), reading("array of episode", path, self._settings):
            layout = header.get("format")
            if layout not in (FORMAT, FIRST_FORMAT):
                raise EpisodeCorrupt(f"{path} has format {layout!r}, known is {FORMAT!r}")
            kept: Any = header["arrays"]
            wanted = [name for name in kept if names is None or layout == FIRST_FORMAT or name in names]
            arrays = {str(name): _read_array(group, str(name)) for name in wanted}
        if digest is not None:
            self._check(path, digest, arrays, kept)
        attributes = header.get("attributes")
        noted = header.get(ATTRIBUTES_DIGEST)  # older episodes have none
        if digest is not None and noted is not None and noted != _digest_of_json(attributes):
            raise EpisodeCorrupt(f"{path}: its attributes do not have the digest they were written with")
        if names is not None:
            arrays = {name: array for name, array in arrays.items() if name in names}
        return arrays, dict(attributes) if isinstance(attributes, dict) else {}

    @staticmethod
    def _check(path: str, digest: str, arrays: Arrays, kept: Any) -> None:
        """Raise EpisodeCorrupt unless the arrays that were read are of the episode with this digest."""
        if isinstance(kept, dict):
            with _decoding(path):
                found = _digest_of(kept)
                changed = [name for name, array in arrays.items() if _part(_plain(name, array)) != kept[name]]
            if changed:
                raise EpisodeCorrupt(
                    f"{path}: {', '.join(changed)} do not have the digest they were written with"
                )
        else:
            found = _first_digest(arrays)
        if found != digest:
            raise EpisodeCorrupt(f"{path} has the digest {found}, committed was {digest}")

    def verified(
        self, path: str, digest: str, names: Collection[str] | None = None
    ) -> tuple[Arrays, dict[str, Any]]:
        """What :meth:`read` gives of a committed episode. Raises EpisodeCorrupt, also where it is gone."""
        try:
            return self.read(path, digest, names)
        except NotFound as error:
            raise EpisodeCorrupt(f"{path} was committed and is gone") from error

    def verify(self, path: str, digest: str) -> None:
        """Raise EpisodeCorrupt unless the episode decodes and has this digest."""
        self.verified(path, digest)

    def write_manifest(self, dataset_id: str, episodes: Iterable[Episode]) -> Artifact:
        """Store the manifest of a dataset; its SHA-256 is the digest of the dataset."""
        lines = [
            ManifestEpisode.model_validate(episode.model_dump())
            for episode in sorted(episodes, key=lambda episode: episode.index)
        ]
        manifest = Manifest(dataset_id=dataset_id, episodes=lines).model_dump(mode="json")
        data = json.dumps(manifest, sort_keys=True, separators=(",", ":")).encode()
        return self._artifacts.put_bytes(data, MANIFEST_NAME, MANIFEST_TYPE)

    def read_manifest(self, sha256: str) -> Manifest:
        """The manifest with this digest. Raises NotFound, ArtifactCorrupt, or EpisodeCorrupt."""
        try:
            return Manifest.model_validate_json(self._artifacts.read_bytes(sha256))
        except ValidationError as error:
            raise EpisodeCorrupt(f"artifact {sha256} is no manifest: {error}") from error

    def iterate(
        self, manifest_sha256: str, *, verify: bool = True
    ) -> Iterator[tuple[ManifestEpisode, Arrays, dict[str, Any]]]:
        """Every episode of a sealed dataset in order, each checked against the manifest."""
        for episode in self.read_manifest(manifest_sha256).episodes:
            arrays, attributes = self.read(episode.path, episode.digest if verify else None)
            yield episode, arrays, attributes

    def remove_orphans(self, dataset_id: str, keep_paths: Iterable[str]) -> list[str]:
        """Remove attempts that were never committed; the paths removed.

        Only when every episode of the dataset is committed: before, an attempt may still be under way.
        """
        folder = f"datasets/{_checked(dataset_id)}/episodes"
        keep = set(keep_paths)
        with reading("dataset", dataset_id, self._settings):
            found = obstore.list_with_delimiter(self._store, prefix=folder)
        paths = {*found["common_prefixes"], *(entry["path"] for entry in found["objects"])}
        orphans = sorted(paths - keep)
        for path in orphans:
            with writing(f"the removal of {path}", 0, self._settings):
                self._remove(path)
        self._remove_unfinished(folder)
        return orphans

    def _group(self, path: str) -> zarr.Group:
        """The episode's group, whose arrays are read when they are asked for."""
        from physworld_storage.episode_files import open_folder, open_packed

        if path.endswith(FILE):
            return open_packed(self._store, path)
        folder = self._settings.store_folder
        return open_folder(
            open_store(self._settings, path, self._patience) if folder is None else folder / path
        )

    def _remove(self, path: str) -> None:
        """Remove an episode, also one of which somebody else has removed a part."""
        if path.endswith(FILE):
            with suppress(NotFoundError, FileNotFoundError):
                obstore.delete(self._store, path)
        for batch in obstore.list(self._store, prefix=path):
            obstore.delete(self._store, [entry["path"] for entry in batch])

    def _remove_unfinished(self, folder: str) -> None:
        """Remove ``NAME#1``: a writer that is killed in the middle leaves it in a local folder; no list shows it."""
        if self._settings.store_folder is not None:
            for part in (self._settings.store_folder / folder).glob("*#*"):
                with writing(f"the removal of {part.name}", 0, self._settings):
                    part.unlink(missing_ok=True)


def episode_path(dataset_id: str, index: int, epoch: int) -> str:
    """Where the attempt with this epoch writes the episode."""
    return f"datasets/{_checked(dataset_id)}/episodes/{index:05d}-e{epoch}.zarr{FILE}"


def arrays_digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 over names and digests of the arrays, by name; an array's is over dtype, shape, little-endian bytes."""
    return _digest_of({name: _part(_plain(name, array)) for name, array in arrays.items()})


def _part(array: NDArray[Any]) -> str:
    """Digest of one plain array."""
    digest = hashlib.sha256(json.dumps([array.dtype.str, array.shape]).encode())
    digest.update(array.data if array.size else b"")
    return digest.hexdigest()


def _digest_of(parts: Mapping[str, str]) -> str:
    """Digest of an episode from those of its arrays."""
    return hashlib.sha256(json.dumps(sorted(parts.items())).encode()).hexdigest()


def _digest_of_json(value: Any) -> str:
    """Digest of a JSON value as it is read again: with text for keys, lists for tuples."""
    plain = json.loads(json.dumps(value))
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _first_digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Digest of an episode of the first format: over name, dtype, shape and bytes of every array, by name."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = _plain(name, arrays[name])
        digest.update(json.dumps([name, array.dtype.str, array.shape]).encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()


def _plain(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Contiguous and little-endian. Raises ValueError for what a store of numbers does not hold."""
    if array.dtype.kind not in "fiub" or array.ndim == 0:
        raise ValueError(
            f"array {name} is {array.dtype} with shape {array.shape}; numbers with axes are kept"
        )
    return np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))


def _read_array(group: zarr.Group, name: str) -> NDArray[Any]:
    import zarr

    stored = group[name]
    if not isinstance(stored, zarr.Array):
        raise EpisodeCorrupt(f"{group.path}/{name} is not an array")
    return np.asarray(stored[...])


def _checked(dataset_id: str) -> str:
    if not DATASET_ID.fullmatch(dataset_id):
        raise ValueError(f"{dataset_id[:80]!r} is not the id of a dataset")
    return dataset_id


@contextmanager
def _decoding(path: str) -> Iterator[None]:
    """What zarr, its codecs and a ZIP raise for bytes that are not what they should be becomes EpisodeCorrupt."""
    try:
        yield
    except (
        ValueError, RuntimeError, LookupError, TypeError, AttributeError, ArithmeticError, EOFError, BadZipFile
    ) as error:  # fmt: skip
        raise EpisodeCorrupt(f"{path} cannot be decoded: {reason(error)}") from error
