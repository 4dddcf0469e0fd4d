"""Datasets: let a twin demonstrate, and read the episodes."""

from __future__ import annotations

import io
import json
from typing import Annotated, Literal

import numpy as np
from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import StreamingResponse

from physworld_schemas.base import Page
from physworld_schemas.dataset import Dataset, DatasetCreate, Episode
from physworld_schemas.job import Job
from physworld_services.api.dependencies import ID_PATTERN, DatabaseDep, ObjectId, PageDep, StoresDep
from physworld_services.api.errors import documented
from physworld_services.api.exports import FORMATS, export
from physworld_services.api.idempotency import IdempotencyDep, accepted
from physworld_services.stores import Stores
from physworld_storage import resources
from physworld_storage.database import Database
from physworld_storage.jobs import jobs

router = APIRouter(prefix="/datasets", tags=["datasets"])

NPZ, ZIP = "application/vnd.numpy.npz", "application/zip"

ExportName = Annotated[
    str,
    Query(
        description="Form, by its name in the catalogue's `exports`.",
        pattern=f"^({'|'.join(FORMATS)})$",
        examples=["lerobot"],
    ),
]
MostPoints = Annotated[
    int | None,
    Query(
        ge=1,
        le=1_000_000,
        description="At most so many particles, spread evenly over the body; empty: what the form takes by itself.",
        json_schema_extra={"unit": "particles"},
        examples=[256],
    ),
]
EpisodeIndex = Annotated[int, Path(ge=0, lt=2**31, description="number of the episode in its dataset")]


@router.post("", status_code=202, response_model=Job, responses=documented(401, 403, 404, 409, 413, 422))
def create_dataset(body: DatasetCreate, idempotency: IdempotencyDep) -> Response:
    """Start the demonstrations of a ready fit; the dataset's id is in the job's `outputs`."""
    return idempotency.run(
        body, lambda session: accepted(jobs.create_dataset(session, body.fit_id, body.config, body.trace_id))
    )


@router.get("", responses=documented(401, 403, 422))
def list_datasets(
    database: DatabaseDep,
    page: PageDep,
    state: Literal["pending", "writing", "sealed", "failed", "cancelled"] | None = None,
    fit_id: Annotated[str | None, Query(pattern=ID_PATTERN)] = None,
    scene_id: Annotated[str | None, Query(pattern=ID_PATTERN)] = None,
) -> Page[Dataset]:
    """Datasets, newest first."""
    with database.reading() as session:
        return resources.list_datasets(
            session, limit=page.limit, cursor=page.cursor, state=state, fit_id=fit_id, scene_id=scene_id
        )


@router.get("/{dataset_id}", responses=documented(401, 403, 404, 422))
def get_dataset(dataset_id: ObjectId, database: DatabaseDep) -> Dataset:
    """A dataset: its state, statistics and manifest."""
    with database.reading() as session:
        return resources.get_dataset(session, dataset_id)


@router.get("/{dataset_id}/episodes", responses=documented(401, 403, 404, 422))
def list_episodes(dataset_id: ObjectId, database: DatabaseDep, page: PageDep) -> Page[Episode]:
    """Committed episodes, by index."""
    with database.reading() as session:
        return resources.list_episodes(session, dataset_id, limit=page.limit, cursor=page.cursor)


@router.get(
    "/{dataset_id}/export",
    response_class=Response,
    responses={
        200: {
            "description": "a ZIP of one folder, sent while it is written",
            "content": {ZIP: {"schema": {"type": "string", "format": "binary"}}},
        },
        **documented(401, 403, 404, 409, 422, 503),
    },
)
def export_dataset(
    dataset_id: ObjectId,
    database: DatabaseDep,
    stores: StoresDep,
    format: ExportName = "lerobot",
    points: MostPoints = None,
) -> Response:
    """All episodes of a sealed dataset in a form that other tools read: LeRobot, PLY or npz."""
    return export_file(dataset_id, format, points, database, stores)


def export_file(
    dataset_id: str, form: str, points: int | None, database: Database, stores: Stores
) -> Response:
    """A dataset as a file to keep; arguments and errors are those of :func:`export`."""
    pieces = export(dataset_id, form, points, database, stores)
    headers = {"Content-Disposition": f'attachment; filename="{dataset_id}-{form}.zip"'}
    return StreamingResponse(pieces, headers=headers, media_type=ZIP)


@router.get(
    "/{dataset_id}/episodes/{index}",
    response_class=Response,
    responses={
        200: {
            "description": "times (T,) s, particles (T, P, 3) m, controllers (T, K, 3) m, properties (P, 2); "
            "`attributes` holds the episode's attributes as JSON text",
            "content": {NPZ: {"schema": {"type": "string", "format": "binary"}}},
        },
        **documented(401, 403, 404, 422, 500, 503),
    },
)
def get_episode(
    dataset_id: ObjectId, index: EpisodeIndex, database: DatabaseDep, stores: StoresDep
) -> Response:
    """The arrays of one episode as npz (no pickles), checked against the digest that was committed."""
    return episode_file(dataset_id, index, database, stores)


def episode_file(dataset_id: str, index: int, database: Database, stores: Stores) -> Response:
    """An episode as a file to keep.

    Args:
        dataset_id: the dataset.
        index: of the episode.
        database: that names its file.
        stores: that hold it.

    Raises:
        NotFound: there is no such episode.
        EpisodeCorrupt: its file is not the one that was committed.
    """
    with database.reading() as session:
        episode = resources.get_episode(session, dataset_id, index)
    arrays, attributes = stores.episodes.verified(episode.path, episode.digest)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, attributes=np.array(json.dumps(attributes)), **arrays)
    name = f"{dataset_id}-{index:05d}.npz"
    headers = {"Content-Disposition": f'attachment; filename="{name}"', "ETag": f'"{episode.digest}"'}
    return Response(buffer.getvalue(), headers=headers, media_type=NPZ)
