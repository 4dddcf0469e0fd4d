"""Liveness, readiness and metrics: without a key, for orchestrators and scrapers.

None of them uses the threads that answer requests, all of which may be waiting for a database that hangs.
"""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import Field

from physworld_schemas.base import Resource
from physworld_services.api.errors import documented, problem_response, request_id_of
from physworld_services.api.probes import READY_S

router = APIRouter(tags=["health"])

_CODES = {"database": "database_unavailable", "store": "store_read_failed"}


class Health(Resource):
    """The answer of a health check: which parts answered."""

    status: str = Field(description="`ok`.", examples=["ok"])
    checks: dict[str, str] = Field(default_factory=dict, description="What each part said, by its name.")


@router.get("/health/live")
async def live() -> Health:
    """The process answers."""
    return Health(status="ok")


@router.get("/health/ready", response_model=Health, responses=documented(503))
async def ready(request: Request) -> Health | Response:
    """Database (with this code's tables) and object store answer; otherwise 503 says which does not, within 2 s.

    The problem then has `checks` as the answer has them: `ok`, or what is wrong with the part.
    """
    probes = request.app.state.probes
    states = await asyncio.gather(*(probe.state(READY_S) for probe in probes))
    checks = {probe.name: state for probe, state in zip(probes, states, strict=True)}
    faults = {name: state for name, state in checks.items() if state != "ok"}
    if not faults:
        return Health(status="ok", checks=checks)
    return problem_response(
        503,
        _CODES[next(iter(faults))],
        "; ".join(f"{name}: {state}" for name, state in faults.items()),
        request_id=request_id_of(request.scope),
        headers={"Retry-After": "2"},
        checks=checks,
    )


@router.get("/metrics", response_class=Response, include_in_schema=False)
async def metrics(request: Request) -> Response:
    """Figures in the Prometheus text format."""
    return Response(await request.app.state.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)
