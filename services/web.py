"""The web process: REST API, dashboard, guide and documentation of the API in one application.

``python -m physworld_services.web --host 127.0.0.1 --port 8000``, or any ASGI server on the factory
``physworld_services.web:create_app``. It reads and writes the database and the store; it never talks to the broker.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import structlog
import uvicorn
from fastapi import FastAPI
from fastapi.responses import RedirectResponse

from physworld_services import guide, interpreter
from physworld_services.api.app import create_api
from physworld_services.api.logs import configure_logs
from physworld_services.connections import Connection, Session
from physworld_services.dashboard.app import mount as mount_dashboard
from physworld_services.stores import open_all
from physworld_storage.settings import Settings, get_settings

GRACEFUL_SHUTDOWN_S = 5


def create_app(settings: Settings | None = None) -> FastAPI:
    """The application on the stores that the settings name.

    Without settings it is a server's factory: the environment's are taken, and logs become JSON lines.
    """
    if settings is None:
        settings = get_settings()
        configure_logs(settings.log_level)
        if (old := interpreter.warning()) is not None:
            structlog.get_logger("physworld.web").warning("old_interpreter", detail=old)
    settings.check(broker=False)
    database, stores = open_all(settings)
    app = create_api(settings, database, stores)
    mount_dashboard(app, settings, database, stores)
    guide.mount(app)

    @app.get("/", include_in_schema=False)
    def home() -> RedirectResponse:
        return RedirectResponse("/dashboard")

    return app


def proxy_options(settings: Settings) -> dict[str, Any]:
    """What uvicorn is told of ``X-Forwarded-For`` and ``-Proto``: believed of the proxies in the settings, of no other.

    Its own default believes every process of this machine, which could then choose its address for each attempt.
    """
    trusted = [address.strip() for address in settings.trusted_proxies.split(",") if address.strip()]
    return {"proxy_headers": bool(trusted), "forwarded_allow_ips": trusted}


def main(arguments: list[str] | None = None) -> int:
    """Serve until told to stop."""
    parser = argparse.ArgumentParser(
        prog="python -m physworld_services.web", description="Serve the API and the dashboard."
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, default=8000, help="port to listen on (default: 8000)")
    options = parser.parse_args(arguments)
    uvicorn.run(
        create_app(),
        host=options.host,
        port=options.port,
        http=Connection,
        ws=Session,
        log_config=None,
        access_log=False,
        server_header=False,
        **proxy_options(get_settings()),
        timeout_graceful_shutdown=GRACEFUL_SHUTDOWN_S,
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
