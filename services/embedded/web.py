"""The web process of the embedded service: serves on a socket that the supervisor listens on.

The supervisor keeps the socket open, so a web process that is started again takes over the port at once and
no connection is refused meanwhile.
"""

from __future__ import annotations

import argparse
import socket
import sys

import uvicorn

from physworld_services.api.logs import configure_logs
from physworld_services.connections import Connection, Session
from physworld_services.web import create_app, proxy_options
from physworld_storage.settings import get_settings

GRACE_S = 3


def main(arguments: list[str] | None = None) -> int:
    """Serve until SIGTERM."""
    parser = argparse.ArgumentParser(prog="python -m physworld_services.embedded.web")
    parser.add_argument("--fd", type=int, required=True, help="descriptor of the listening socket")
    options = parser.parse_args(arguments)
    settings = get_settings()
    configure_logs(settings.log_level)
    config = uvicorn.Config(
        create_app(settings),
        http=Connection,
        ws=Session,
        log_config=None,
        access_log=False,
        server_header=False,
        **proxy_options(settings),
        timeout_graceful_shutdown=GRACE_S,
    )
    server = uvicorn.Server(config)
    with socket.socket(fileno=options.fd) as listening:
        server.run(sockets=[listening])
    return 0 if server.started else 1


if __name__ == "__main__":
    sys.exit(main())
