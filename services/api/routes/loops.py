"""Loops: from a recording that a model predicts badly to its next version, with the errors of both."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from physworld_schemas.base import Page
from physworld_schemas.job import Job, JobState
from physworld_schemas.loop import Loop, LoopCreate
from physworld_services.api.dependencies import DatabaseDep, ObjectId, PageDep
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import IdempotencyDep, accepted
from physworld_services.api.routes.library import require_known
from physworld_storage import loops
from physworld_storage.jobs import jobs

router = APIRouter(prefix="/loops", tags=["loops"])


@router.post("", status_code=202, response_model=Job, responses=documented(401, 403, 404, 409, 413, 422))
def create_loop(body: LoopCreate, idempotency: IdempotencyDep) -> Response:
    """Hold a new recording against a model; where the model errs more than expected, trace why and train the next
    version.

    The loop's id is the job's. It ends without a new version where the model errs no more than its card promises or
    where the trace supports no effect.
    """
    require_known(trace=body.trace)
    return idempotency.run(body, lambda session: accepted(jobs.create_loop(session, body)))


@router.get("", responses=documented(401, 403, 422))
def list_loops(
    database: DatabaseDep,
    page: PageDep,
    state: JobState | None = None,
    model: Annotated[str | None, Query(max_length=64, description="Only loops of this model.")] = None,
) -> Page[Loop]:
    """Loops, newest first."""
    with database.reading() as session:
        return loops.list_loops(session, limit=page.limit, cursor=page.cursor, state=state, model=model)


@router.get("/{loop_id}", responses=documented(401, 403, 404, 422))
def get_loop(loop_id: ObjectId, database: DatabaseDep) -> Loop:
    """A loop: how it ended, what it made, and the errors of both versions on the recording's held-out frames."""
    with database.reading() as session:
        return loops.get_loop(session, loop_id)
