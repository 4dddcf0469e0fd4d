"""The episode store: one zarr group for each attempt at an episode, one shard for each of its arrays.

``datasets/{dataset}/episodes/{index}-e{epoch}.zarr`` belongs to one lease (``epoch`` is its fencing token),
so no two writers ever share a shard or a piece of metadata. An episode exists once the database has committed
its path and digest; anything else below ``episodes/`` is an orphan of a dead attempt. A sealed dataset is its
manifest: an artifact that lists (path, digest) of every episode.

Arrays (T frames, P particles, K controllers): ``times`` (T,) f8 [s]; ``particles`` (T, P, 3) f4 [m];
``controllers`` (T, K, 3) f4 [m]; ``properties`` (P, 2 or 3) f4, log(E/E_fit), log(rho/rho_fit) and, where the
ground's friction is perturbed, log(mu/mu_fit); ``vertices`` (T, M, 3) f4 [m] and ``vertex_index`` (M,) i4: some of
the particles again, those that a world model takes for its vertices, so that a training need not read the others.
Chunks lie along the first axis inside a shard, so a window of frames can be read without the rest.

The digest of an episode is over the digests of its arrays, so that a part can be read and verified alone. Episodes of
the first format have one digest over all bytes and are read whole. Attributes are no part of it, so that episodes made
again from another upload of the same scene keep theirs; they stand beside a digest of their own.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
from collections.abc import Callable, Collection, Coroutine, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
import obstore
import zarr
import zarr.api.asynchronous
from numpy.typing import NDArray
from obstore.exceptions import BaseError
from pydantic import ValidationError
from zarr.codecs import BloscCodec
from zarr.core.buffer import Buffer
from zarr.storage import LocalStore as ZarrLocalStore
from zarr.storage import ObjectStore as ZarrObjectStore

from schemas.base import Artifact, Resource
from schemas.dataset import Episode
from storage.artifacts import ArtifactStore
from storage.errors import EpisodeCorrupt, NotFound, StoreError
from storage.settings import Settings
from storage.store import Store, open_store, reading, writing

T = TypeVar("T")
Arrays = dict[str, NDArray[Any]]

CHUNK_BYTES = 1 << 20
PACKED_BYTES = 1 << 14
"""Smaller arrays are not compressed: it would save less than a block of the disk."""
FORMAT, FIRST_FORMAT = "physworld-episode/2", "physworld-episode/1"
ATTRIBUTES_DIGEST = "attributes_sha256"
MANIFEST_NAME = "manifest.json"
MANIFEST_TYPE = "application/json"
DATASET_ID = re.compile(r"[A-Za-z0-9_-]+")
EPISODE_PATH = re.compile(r"datasets/[A-Za-z0-9_-]+/episodes/[0-9]{5,}-e[0-9]+\.zarr")


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


class _AnyBucket(ZarrObjectStore[Store]):
    """A bucket of any S3 server: one that ignores ``If-None-Match`` would replace a group's header by an empty one."""

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """An episode has one writer: nothing comes between the look and the write."""
        if not await self.exists(key):
            await self.set(key, value)


class EpisodeStore:
    """Episodes in a local folder or a bucket."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._store = open_store(settings)
        self._artifacts = ArtifactStore(settings)

    def write(
        self,
        dataset_id: str,
        index: int,
        epoch: int,
        arrays: Mapping[str, NDArray[Any]],
        attributes: Mapping[str, Any],
    ) -> tuple[str, str]:
        """Write one attempt at an episode; its path and the digest of its arrays.

        Raises StoreWriteFailed or StoreFull, and removes what it had written of it.
        """
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
        try:
            with writing(f"episode {path}", size, self._settings):
                _finish(_write_group(self._zarr(path), header, plain))
        except StoreError:
            self._remove_quietly(path)
            raise
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
            group = zarr.open_group(self._zarr(path), mode="r", zarr_format=3, use_consolidated=False)
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
            found = obstore.list_with_delimiter(self._store, prefix=folder)["common_prefixes"]
        orphans = sorted(path for path in found if path not in keep)
        for path in orphans:
            with writing(f"the removal of {path}", 0, self._settings):
                self._remove(path)
        return orphans

    def _zarr(self, path: str) -> ZarrLocalStore | ZarrObjectStore[Store]:
        """A zarr store whose root is the episode: zarr writes nothing above it."""
        folder = self._settings.store_folder
        if folder is not None:
            return ZarrLocalStore(folder / path)
        return _AnyBucket(open_store(self._settings, path))

    def _remove(self, path: str) -> None:
        for batch in obstore.list(self._store, prefix=path):
            obstore.delete(self._store, [entry["path"] for entry in batch])

    def _remove_quietly(self, path: str) -> None:
        """Tidy up after a failed write; what cannot be removed now is an orphan until the seal."""
        try:
            self._remove(path)
        except (OSError, BaseError):
            return


def episode_path(dataset_id: str, index: int, epoch: int) -> str:
    """Where the attempt with this epoch writes the episode."""
    return f"datasets/{_checked(dataset_id)}/episodes/{index:05d}-e{epoch}.zarr"


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


def _finish(work: Coroutine[Any, Any, None]) -> None:
    """Run ``work`` to its end on a loop of its own, in another thread where this one has a loop that runs."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        asyncio.run(work)
        return
    with ThreadPoolExecutor(max_workers=1) as thread:
        thread.submit(asyncio.run, work).result()


class _Here(ThreadPoolExecutor):
    """No pool: zarr hands every file and every chunk of an episode to a thread, which costs more than its work."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Done at once, in the caller's thread; what it raises is raised here."""
        done: Future[T] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


async def _write_group(
    place: ZarrLocalStore | ZarrObjectStore[Store], header: dict[str, Any], arrays: Arrays
) -> None:
    """Group and arrays on an event loop of this thread: zarr's own, in another one, costs half as much again."""
    asyncio.get_running_loop().set_default_executor(_Here())
    group = await zarr.api.asynchronous.create_group(store=place, overwrite=True, attributes=header)
    for name, array in arrays.items():
        await _write_array(group, name, array)


async def _write_array(group: zarr.AsyncGroup, name: str, array: NDArray[Any]) -> None:
    """One file beside its metadata: a shard of chunks, or a chunk alone where one holds all.

    LZ4 with shuffled bytes leaves as much of floating-point tracks as zstd does, in two thirds of its time.
    """
    row = max(1, array.nbytes // max(1, array.shape[0]))
    rows = max(1, min(array.shape[0], CHUNK_BYTES // row))
    rest = tuple(max(1, length) for length in array.shape[1:])
    shards = -(-max(1, array.shape[0]) // rows) * rows
    packed = array.nbytes >= PACKED_BYTES
    stored = await group.create_array(
        name,
        shape=array.shape,
        dtype=array.dtype,
        chunks=(rows, *rest),
        shards=(shards, *rest) if shards > rows else None,
        compressors=BloscCodec(cname="lz4", clevel=1, shuffle="shuffle") if packed else None,
        fill_value=np.nan if array.dtype.kind == "f" else 0,  # a lost file must not read as zeros
        config={"write_empty_chunks": True},
    )
    await stored.setitem(..., array)


def _read_array(group: zarr.Group, name: str) -> NDArray[Any]:
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
    """What zarr and its codecs raise for bytes that are not what they should be becomes EpisodeCorrupt."""
    try:
        yield
    except (ValueError, RuntimeError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        raise EpisodeCorrupt(f"{path} cannot be decoded: {type(error).__name__}: {error}") from error
