"""Checks: ask what a recording can show before any fit, and read the answer."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from physworld_schemas.base import Page
from physworld_schemas.check import Check, CheckCreate, CheckState
from physworld_schemas.job import Job
from physworld_services.api.dependencies import ID_PATTERN, DatabaseDep, ObjectId, PageDep
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import IdempotencyDep, accepted
from physworld_services.api.routes.library import require_known
from physworld_storage import checks
from physworld_storage.jobs import jobs

router = APIRouter(prefix="/checks", tags=["checks"])


@router.post("", status_code=202, response_model=Job, responses=documented(401, 403, 404, 409, 413, 422))
def create_check(body: CheckCreate, idempotency: IdempotencyDep) -> Response:
    """Check what a scene's motion can show, before any fit; the check's id is in the job's `outputs`."""
    require_known(config=body.config)
    return idempotency.run(body, lambda session: accepted(jobs.create_check(session, body)))


@router.get("", responses=documented(401, 403, 422))
def list_checks(
    database: DatabaseDep,
    page: PageDep,
    state: CheckState | None = None,
    scene_id: Annotated[str | None, Query(pattern=ID_PATTERN)] = None,
) -> Page[Check]:
    """Checks, newest first."""
    with database.reading() as session:
        return checks.list_checks(
            session, limit=page.limit, cursor=page.cursor, state=state, scene_id=scene_id
        )


@router.get("/{check_id}", responses=documented(401, 403, 404, 422))
def get_check(check_id: ObjectId, database: DatabaseDep) -> Check:
    """A check: once it is ready, the expected interval of every number and the detectable size of every effect."""
    with database.reading() as session:
        return checks.get_check(session, check_id)
