"""Liveness, readiness and metrics: without a key, for orchestrators and scrapers."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import Field

from schemas.base import Resource
from services.api.dependencies import DatabaseDep, StoresDep
from services.api.errors import documented

router = APIRouter(tags=["health"])

_ABSENT = "0" * 64


class Health(Resource):
    """The answer of a health check: which parts answered."""

    status: str
    checks: dict[str, str] = Field(default_factory=dict)


@router.get("/health/live")
def live() -> Health:
    """The process answers."""
    return Health(status="ok")


@router.get("/health/ready", responses=documented(503))
def ready(database: DatabaseDep, stores: StoresDep) -> Health:
    """Database (with this code's tables) and object store answer; otherwise 503 says which does not."""
    database.check()
    stores.artifacts.exists(_ABSENT)
    return Health(status="ok", checks={"database": "ok", "store": "ok"})


@router.get("/metrics", response_class=Response, include_in_schema=False)
def metrics(request: Request) -> Response:
    """Figures in the Prometheus text format."""
    return Response(request.app.state.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)
