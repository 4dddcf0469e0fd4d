"""World models: train and publish a version, look versions up, move aliases."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Path, Response

from schemas.base import Page
from schemas.job import Job
from schemas.model import AliasSet, Model, ModelVersion, TrainingCreate
from services.api.dependencies import DatabaseDep, ModelName, PageDep
from services.api.errors import documented
from services.api.idempotency import IdempotencyDep, accepted
from storage import jobs, registry

router = APIRouter(prefix="/models", tags=["models"])

Version = Annotated[
    str, Path(pattern=r"^([1-9][0-9]{0,8}|[a-z][a-z0-9_-]{0,31})$", description="number, alias or `latest`")
]
Alias = Annotated[str, Path(pattern=r"^[a-z][a-z0-9_-]{0,31}$")]


@router.post("", status_code=202, response_model=Job, responses=documented(401, 403, 404, 409, 413, 422))
def create_model(body: TrainingCreate, idempotency: IdempotencyDep) -> Response:
    """Train on a sealed dataset and publish the next version of `name`; it is in the job's `outputs`."""
    return idempotency.run(body, lambda session: accepted(jobs.create_training(session, body)))


@router.get("", responses=documented(401, 403, 422))
def list_models(database: DatabaseDep, page: PageDep) -> Page[Model]:
    """Registered names, newest first."""
    with database.reading() as session:
        return registry.list_models(session, limit=page.limit, cursor=page.cursor)


@router.get("/{name}", responses=documented(401, 403, 404, 422))
def get_model(name: ModelName, database: DatabaseDep) -> Model:
    """A name, its newest version and its aliases."""
    with database.reading() as session:
        return registry.get_model(session, name)


@router.get("/{name}/versions", responses=documented(401, 403, 404, 422))
def list_versions(
    name: ModelName,
    database: DatabaseDep,
    page: PageDep,
    state: Literal["pending", "ready", "failed"] | None = None,
) -> Page[ModelVersion]:
    """Versions, newest first."""
    with database.reading() as session:
        return registry.list_versions(session, name, limit=page.limit, cursor=page.cursor, state=state)


@router.get("/{name}/versions/{version}", responses=documented(401, 403, 404, 422))
def get_version(name: ModelName, version: Version, database: DatabaseDep) -> ModelVersion:
    """A version by number, by alias, or the newest ready one as `latest`."""
    with database.reading() as session:
        return registry.get_version(session, name, version)


@router.put("/{name}/aliases/{alias}", responses=documented(401, 403, 404, 409, 413, 422))
def set_alias(name: ModelName, alias: Alias, body: AliasSet, database: DatabaseDep) -> Model:
    """Point an alias at a ready version; it moves if it exists."""
    with database.session() as session:
        return registry.set_alias(session, name, alias, body.version)


@router.delete("/{name}/aliases/{alias}", responses=documented(401, 403, 404, 422))
def delete_alias(name: ModelName, alias: Alias, database: DatabaseDep) -> Model:
    """Remove an alias; the version stays."""
    with database.session() as session:
        return registry.delete_alias(session, name, alias)
