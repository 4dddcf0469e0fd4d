"""Fits: calibrate a twin of a scene, and read what came of it."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from physworld_schemas.base import Page
from physworld_schemas.fit import Fit, FitCreate
from physworld_schemas.job import Job
from physworld_services.api.dependencies import ID_PATTERN, DatabaseDep, ObjectId, PageDep
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import IdempotencyDep, accepted
from physworld_services.api.routes.library import require_known
from physworld_storage import resources
from physworld_storage.jobs import jobs

router = APIRouter(prefix="/fits", tags=["fits"])


@router.post("", status_code=202, response_model=Job, responses=documented(401, 403, 404, 409, 413, 422))
def create_fit(body: FitCreate, idempotency: IdempotencyDep) -> Response:
    """Start a calibration; the fit's id is in the job's `outputs`."""
    require_known(config=body.config)
    return idempotency.run(
        body,
        lambda session: accepted(
            jobs.create_fit(session, body.scene_id, body.config, scene_ids=body.scene_ids)
        ),
    )


@router.get("", responses=documented(401, 403, 422))
def list_fits(
    database: DatabaseDep,
    page: PageDep,
    state: Literal["pending", "ready", "failed", "cancelled"] | None = None,
    scene_id: Annotated[str | None, Query(pattern=ID_PATTERN)] = None,
) -> Page[Fit]:
    """Fits, newest first."""
    with database.reading() as session:
        return resources.list_fits(
            session, limit=page.limit, cursor=page.cursor, state=state, scene_id=scene_id
        )


@router.get("/{fit_id}", responses=documented(401, 403, 404, 422))
def get_fit(fit_id: ObjectId, database: DatabaseDep) -> Fit:
    """A fit: parameters with their intervals, metrics, artifacts."""
    with database.reading() as session:
        return resources.get_fit(session, fit_id)
