"""A dataset as other tools read it, as one ZIP that is sent while it is written.

The writers are the SDK's (``physworld_client.export``), which write files into a folder. Episode by episode what they
have finished goes into the ZIP and leaves the folder, so that a large dataset needs neither memory nor a copy on the
disk; the first bytes come at once. A digest that does not fit breaks the download off: the ZIP then lacks its directory
and no reader takes it for whole.
"""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from physworld_client.errors import ExportRefused
from physworld_client.export import Writer, open_export

from physworld_schemas.dataset import Dataset, Episode
from physworld_schemas.library import catalogue
from physworld_services.api.errors import ApiProblem
from physworld_services.stores import Stores
from physworld_storage import resources
from physworld_storage.database import Database

FORMATS = tuple(form.name for form in catalogue().exports)
PIECE_BYTES = 1 << 20
SPEED = 1
"""Of the compression: parquet is packed already, particles hardly shrink."""


class _Pipe(io.RawIOBase):
    """Takes what the ZIP writes, to be sent."""

    def __init__(self) -> None:
        self._kept = bytearray()

    def writable(self) -> bool:
        """Always."""
        return True

    def write(self, data: object, /) -> int:
        """Keep it."""
        piece = memoryview(data)  # type: ignore[arg-type]  # a buffer, as RawIOBase says
        self._kept += piece
        return piece.nbytes

    def taken(self) -> bytes:
        """All that was written since the last time."""
        kept, self._kept = bytes(self._kept), bytearray()
        return kept


def export(
    dataset_id: str, form: str, points: int | None, database: Database, stores: Stores
) -> Iterator[bytes]:
    """The ZIP of a sealed dataset in a form of the catalogue, piece by piece.

    Args:
        dataset_id: of the dataset.
        form: one of ``FORMATS``.
        points: at most so many particles; None: as many as the form has by itself.
        database: names the episodes.
        stores: hold them.

    Raises:
        NotFound: no such dataset.
        ApiProblem: 409 for one that is not sealed, 503 where a package of the form is not installed.
    """
    with database.reading() as session:
        dataset = resources.get_dataset(session, dataset_id)
        episodes = resources.all_episodes(session, dataset_id) if dataset.state == "sealed" else []
    if dataset.state != "sealed":
        raise ApiProblem(
            409, "conflict", f"dataset {dataset_id} is {dataset.state}; only a sealed one is exported"
        )
    folder = tempfile.TemporaryDirectory(prefix="export-")
    try:
        writer = open_export(form, folder.name, dataset, points)
    except ExportRefused as error:
        folder.cleanup()
        raise ApiProblem(503, "unavailable", str(error)) from error
    return _pieces(folder, writer, dataset, episodes, stores)


def _pieces(
    folder: tempfile.TemporaryDirectory[str],
    writer: Writer,
    dataset: Dataset,
    episodes: list[Episode],
    stores: Stores,
) -> Iterator[bytes]:
    pipe, place = _Pipe(), Path(folder.name)
    with folder, zipfile.ZipFile(pipe, "w", zipfile.ZIP_DEFLATED, compresslevel=SPEED) as archive:
        yield from _sent(archive, pipe, place, dataset.id, None)
        for episode in episodes:
            arrays, attributes = stores.episodes.verified(episode.path, episode.digest)
            writer.add(episode.index, {**arrays, "attributes": np.array(json.dumps(attributes))})
            yield from _sent(archive, pipe, place, dataset.id, writer.unfinished)
        writer.finish()
        yield from _sent(archive, pipe, place, dataset.id, None)
    yield pipe.taken()


def _sent(
    archive: zipfile.ZipFile, pipe: _Pipe, place: Path, top: str, unfinished: Path | None
) -> Iterator[bytes]:
    """Put every file of the folder but one into the ZIP, below a folder ``top``, and remove it."""
    for file in sorted(path for path in place.rglob("*") if path.is_file() and path != unfinished):
        name = f"{top}/{file.relative_to(place).as_posix()}"
        with file.open("rb") as source, archive.open(name, "w", force_zip64=True) as target:
            while piece := source.read(PIECE_BYTES):
                target.write(piece)
                yield pipe.taken()
        file.unlink()
    yield pipe.taken()
