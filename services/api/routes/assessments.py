"""Assessments: does a published model still predict its object, or is something new in the recording?"""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from physworld_schemas.assessment import Assessment, AssessmentCreate
from physworld_schemas.base import Page
from physworld_schemas.job import Job
from physworld_services.api.dependencies import DatabaseDep, ModelName, ObjectId, PageDep
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import IdempotencyDep, accepted
from physworld_services.api.routes.library import require_known
from physworld_services.api.routes.models import Version
from physworld_storage import registry, traces
from physworld_storage.jobs import jobs

router = APIRouter(tags=["assessments"])


@router.post(
    "/models/{name}/versions/{version}/assessments",
    status_code=202,
    response_model=Job,
    responses=documented(401, 403, 404, 409, 413, 422),
)
def create_assessment(
    name: ModelName, version: Version, body: AssessmentCreate, idempotency: IdempotencyDep
) -> Response:
    """Hold a new recording of the object against a version; the assessment's id is in the job's `outputs`.

    Where the error is above noise and above what the version's card lets expect, a trace of the recording is opened.
    """
    require_known(trace=body.trace)
    return idempotency.run(
        body,
        lambda session: accepted(
            jobs.create_assessment(session, name, registry.resolve(session, name, version), body)
        ),
    )


@router.get("/models/{name}/versions/{version}/assessments", responses=documented(401, 403, 404, 422))
def list_assessments_of_version(
    name: ModelName, version: Version, database: DatabaseDep, page: PageDep
) -> Page[Assessment]:
    """Assessments of a version, newest first."""
    with database.reading() as session:
        number = registry.get_version(session, name, version).version
        return traces.list_assessments(session, name, number, limit=page.limit, cursor=page.cursor)


@router.get("/assessments", responses=documented(401, 403, 422))
def list_assessments(
    database: DatabaseDep, page: PageDep, model: Annotated[str | None, Query(max_length=64)] = None
) -> Page[Assessment]:
    """Assessments of every model, newest first."""
    with database.reading() as session:
        return traces.list_assessments(session, model, limit=page.limit, cursor=page.cursor)


@router.get("/assessments/{assessment_id}", responses=documented(401, 403, 404, 422))
def get_assessment(assessment_id: ObjectId, database: DatabaseDep) -> Assessment:
    """An assessment: the outcome with its figures, and the trace that it opened."""
    with database.reading() as session:
        return traces.get_assessment(session, assessment_id)
