"""World models: train and publish a version, look versions up, compare them, describe them, move aliases."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Path, Query, Response

from physworld_schemas.base import Page
from physworld_schemas.job import Job
from physworld_schemas.model import (
    AliasSet,
    Model,
    ModelComparison,
    ModelVersion,
    TrainingCreate,
    VersionPatch,
)
from physworld_services.api.dependencies import ActorDep, DatabaseDep, ModelName, PageDep
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import IdempotencyDep, accepted
from physworld_storage import registry
from physworld_storage.access import audit
from physworld_storage.comparison import compare_versions
from physworld_storage.jobs import jobs

router = APIRouter(prefix="/models", tags=["models"])

VERSION = r"^([1-9][0-9]{0,8}|[a-z][a-z0-9_-]{0,31})$"
Version = Annotated[str, Path(pattern=VERSION, description="number, alias or `latest`")]
OneOfTwo = Annotated[str, Query(pattern=VERSION, description="number, alias or `latest`")]
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
    state: Literal["pending", "ready", "failed", "cancelled"] | None = None,
) -> Page[ModelVersion]:
    """Versions, newest first."""
    with database.reading() as session:
        return registry.list_versions(session, name, limit=page.limit, cursor=page.cursor, state=state)


@router.get("/{name}/versions/{version}", responses=documented(401, 403, 404, 422))
def get_version(name: ModelName, version: Version, database: DatabaseDep) -> ModelVersion:
    """A version by number, by alias, or the newest ready one as `latest`."""
    with database.reading() as session:
        return registry.get_version(session, name, version)


@router.patch("/{name}/versions/{version}", responses=documented(401, 403, 404, 413, 422))
def patch_version(
    name: ModelName, version: Version, body: VersionPatch, database: DatabaseDep
) -> ModelVersion:
    """Change description and tags. The files of a ready version never change."""
    with database.session() as session:
        return registry.patch_version(session, name, version, body)


@router.get("/{name}/compare", responses=documented(401, 403, 404, 409, 422))
def compare(name: ModelName, a: OneOfTwo, b: OneOfTwo, database: DatabaseDep) -> ModelComparison:
    """Two ready versions: errors with intervals and paired gains, curves, and what differs in how they were made."""
    with database.reading() as session:
        pair = registry.get_version(session, name, a), registry.get_version(session, name, b)
    return compare_versions(*pair)


@router.put("/{name}/aliases/{alias}", responses=documented(401, 403, 404, 409, 413, 422))
def set_alias(name: ModelName, alias: Alias, body: AliasSet, database: DatabaseDep, actor: ActorDep) -> Model:
    """Point an alias at a ready version; it moves if it exists."""
    with database.session() as session:
        audit.record(session, actor, "alias.set", f"{name}@{alias}", version=body.version)
        return registry.set_alias(session, name, alias, body.version)


@router.delete("/{name}/aliases/{alias}", responses=documented(401, 403, 404, 422))
def delete_alias(name: ModelName, alias: Alias, database: DatabaseDep, actor: ActorDep) -> Model:
    """Remove an alias; the version stays."""
    with database.session() as session:
        audit.record(session, actor, "alias.removed", f"{name}@{alias}")
        return registry.delete_alias(session, name, alias)
