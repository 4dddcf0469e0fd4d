"""The whole chain in one call: fit, trace where it is asked for, dataset, training."""

from __future__ import annotations

from fastapi import APIRouter, Response

from physworld_schemas.job import Job
from physworld_schemas.pipeline import PipelineCreate
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import IdempotencyDep, accepted
from physworld_services.api.routes.library import require_known
from physworld_storage.jobs import jobs

router = APIRouter(prefix="/pipelines", tags=["pipelines"])


@router.post("", status_code=202, response_model=Job, responses=documented(401, 403, 404, 409, 413, 422))
def create_pipeline(body: PipelineCreate, idempotency: IdempotencyDep) -> Response:
    """Calibrate a twin of a scene, let it demonstrate, train a world model on it and publish that.

    With `close_the_loop` what the twin leaves is traced first, and the twin with the named effect demonstrates.
    """
    require_known(fit=body.fit, trace=body.trace)
    return idempotency.run(body, lambda session: accepted(jobs.create_pipeline(session, body)))
