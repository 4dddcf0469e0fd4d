"""The REST API as one FastAPI application: routes, middleware, problems, offline documentation."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import import_module
from pkgutil import iter_modules

import anyio
from fastapi import APIRouter, FastAPI
from fastapi_offline import FastAPIOffline

import physworld
from physworld_services.api import errors, routes
from physworld_services.api.access import Access
from physworld_services.api.attempts import Attempts
from physworld_services.api.closing import Closing
from physworld_services.api.ending import Endings, EndWithCredential
from physworld_services.api.feed import Feed
from physworld_services.api.limits import BodyLimit
from physworld_services.api.metrics import Metrics
from physworld_services.api.openapi import describe
from physworld_services.api.parsing import Parsers
from physworld_services.api.probes import Probe
from physworld_services.api.routes import health, live
from physworld_services.api.security import Authentication, Gate, bearer
from physworld_services.stores import Stores
from physworld_storage.database import Database
from physworld_storage.settings import Settings

VERSION = physworld.__version__
PREFIX = "/v1"
ABSENT = "0" * 64  # the digest of no artifact
PARALLEL_UPLOADS = 2  # each by a process of its own


def create_api(settings: Settings, database: Database, stores: Stores) -> FastAPI:
    """The application on opened stores; its documentation is served from the installed package, at /docs."""
    closing, parsers = Closing(), Parsers(PARALLEL_UPLOADS)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with closing.lifespan(app):
            yield
        parsers.close()

    app = FastAPIOffline(
        title="PhysWorld",
        version=VERSION,
        summary="From a recording of a deformable object to a published world model",
        redoc_url=None,
        docs_url="/docs",
        lifespan=lifespan,
    )
    app.state.closing = closing
    app.state.feed = Feed(database, closing)
    app.state.settings = settings
    app.state.database = database
    app.state.stores = stores
    app.state.metrics = Metrics(database)
    app.state.probes = (
        Probe("database", lambda: database.check()),
        Probe("store", lambda: stores.artifacts.exists(ABSENT)),
    )
    app.state.gate = Gate(database, Attempts())
    app.state.endings = Endings(database)
    app.state.upload_slots = anyio.CapacityLimiter(PARALLEL_UPLOADS)
    app.state.parsers = parsers
    versioned = APIRouter(prefix=PREFIX, dependencies=[bearer])
    for name in sorted(part.name for part in iter_modules(routes.__path__)):
        module = import_module(f"{routes.__name__}.{name}")
        if module is not health:
            versioned.include_router(module.router)
    app.include_router(versioned)
    app.include_router(live.sockets, prefix=PREFIX)
    app.include_router(health.router)
    errors.install(app)
    describe(app)
    # The last one added runs first: access log, then body limit, then authentication, then ends of credentials.
    app.add_middleware(EndWithCredential, endings=app.state.endings)
    app.add_middleware(Authentication, gate=app.state.gate, prefix=PREFIX)
    app.add_middleware(BodyLimit, max_upload_bytes=settings.max_upload_bytes)
    app.add_middleware(Access, metrics=app.state.metrics)
    return app
