"""The REST API as one FastAPI application: routes, middleware, problems, offline documentation."""

from __future__ import annotations

import anyio
from fastapi import APIRouter, FastAPI
from fastapi_offline import FastAPIOffline

from services.api import errors
from services.api.access import Access
from services.api.closing import Closing
from services.api.limits import BodyLimit
from services.api.metrics import Metrics
from services.api.openapi import describe
from services.api.routes import (
    artifacts,
    assessments,
    datasets,
    fits,
    health,
    jobs,
    keys,
    library,
    live,
    models,
    pipelines,
    plans,
    rollouts,
    scenes,
    signing_keys,
    traces,
)
from services.api.security import Authentication, bearer
from services.stores import Stores
from storage.database import Database
from storage.settings import Settings

VERSION = "0.1.0"
PREFIX = "/v1"
PARALLEL_UPLOADS = 2  # each holds its file in memory while it is parsed


def create_api(settings: Settings, database: Database, stores: Stores) -> FastAPI:
    """The application on opened stores; its documentation is served from the installed package, at /docs."""
    closing = Closing()
    app = FastAPIOffline(
        title="PhysWorld",
        version=VERSION,
        summary="From a recording of a deformable object to a published world model",
        redoc_url=None,
        docs_url="/docs",
        lifespan=closing.lifespan,
    )
    app.state.closing = closing
    app.state.settings = settings
    app.state.database = database
    app.state.stores = stores
    app.state.metrics = Metrics(database)
    app.state.upload_slots = anyio.CapacityLimiter(PARALLEL_UPLOADS)
    versioned = APIRouter(prefix=PREFIX, dependencies=[bearer])
    for module in (
        scenes,
        fits,
        traces,
        datasets,
        models,
        assessments,
        rollouts,
        plans,
        live,
        pipelines,
        jobs,
        artifacts,
        library,
        signing_keys,
        keys,
    ):
        versioned.include_router(module.router)
    app.include_router(versioned)
    app.include_router(live.sockets, prefix=PREFIX)
    app.include_router(health.router)
    errors.install(app)
    describe(app)
    # The last one added runs first: access log, then body limit, then authentication.
    app.add_middleware(Authentication, database=database, prefix=PREFIX)
    app.add_middleware(BodyLimit, max_upload_bytes=settings.max_upload_bytes)
    app.add_middleware(Access, metrics=app.state.metrics)
    return app
