"""Traces: let what a twin leaves be traced to an effect that it lacks, and read the answer."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse

from physworld_schemas.base import Page
from physworld_schemas.job import Job
from physworld_schemas.trace import Trace, TraceCreate, TraceState, Verdict
from physworld_services.api.dependencies import ID_PATTERN, DatabaseDep, ObjectId, PageDep, StoresDep
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import IdempotencyDep, accepted
from physworld_services.api.ranges import etag
from physworld_services.api.routes.library import require_known
from physworld_storage import traces
from physworld_storage.errors import Conflict
from physworld_storage.jobs import jobs

router = APIRouter(prefix="/traces", tags=["traces"])

NPZ = "application/vnd.numpy.npz"


@router.post("", status_code=202, response_model=Job, responses=documented(401, 403, 404, 409, 413, 422))
def create_trace(body: TraceCreate, idempotency: IdempotencyDep) -> Response:
    """Trace a scene's residual to a named effect; the trace's id is in the job's `outputs`."""
    require_known(config=body.config)
    return idempotency.run(body, lambda session: accepted(jobs.create_trace(session, body)))


@router.get("", responses=documented(401, 403, 422))
def list_traces(
    database: DatabaseDep,
    page: PageDep,
    state: TraceState | None = None,
    scene_id: Annotated[str | None, Query(pattern=ID_PATTERN)] = None,
    verdict: Verdict | None = None,
) -> Page[Trace]:
    """Traces, newest first."""
    with database.reading() as session:
        return traces.list_traces(
            session, limit=page.limit, cursor=page.cursor, state=state, scene_id=scene_id, verdict=verdict
        )


@router.get("/{trace_id}", responses=documented(401, 403, 404, 422))
def get_trace(trace_id: ObjectId, database: DatabaseDep) -> Trace:
    """A trace: the verdict and every figure of its report once it is ready, and its files."""
    with database.reading() as session:
        return traces.get_trace(session, trace_id)


@router.get(
    "/{trace_id}/tracks",
    response_class=Response,
    responses={
        200: {
            "description": "times (T,) s, before and after (T, N, 3) m: open-loop tracks without and with the effects",
            "content": {NPZ: {"schema": {"type": "string", "format": "binary"}}},
        },
        **documented(401, 403, 404, 409, 422, 503),
    },
)
def get_tracks(trace_id: ObjectId, database: DatabaseDep, stores: StoresDep) -> Response:
    """The predicted tracks before and after as npz (no pickles), so that anyone can score them."""
    with database.reading() as session:
        trace = traces.get_trace(session, trace_id)
    found = next((item for item in trace.artifacts if item.name == traces.TRACKS), None)
    if found is None:
        raise Conflict(f"trace {trace_id} is {trace.state}; its tracks exist once it is ready")
    headers = {
        "Content-Disposition": f'attachment; filename="{trace_id}-tracks.npz"',
        "Content-Length": str(found.size),
        "ETag": etag(found.sha256),
    }
    return StreamingResponse(stores.artifacts.open(found.sha256), headers=headers, media_type=NPZ)
