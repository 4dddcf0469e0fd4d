"""``python -m physworld_services.inference serve [--host H] [--port P | --fd N]`` and ``python -m
physworld_services.inference work``."""

from __future__ import annotations

import argparse
import logging
import os
import socket
import sys

from physworld_storage.settings import Settings, get_settings

GRACE_S = 2


def main(arguments: list[str] | None = None) -> int:
    """Serve, or work on the queue, until told to stop."""
    parser = argparse.ArgumentParser(prog="python -m physworld_services.inference", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    serve = commands.add_parser("serve", help="answer rollouts and live sessions for the API")
    serve.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    serve.add_argument("--port", type=int, default=8100, help="port to listen on (default: 8100)")
    serve.add_argument("--fd", type=int, default=None, help="descriptor of a listening socket instead")
    work = commands.add_parser("work", help="do rollouts and plans from the queue")
    work.add_argument("--name", default="planner", help="name of this worker on its host (default: planner)")
    options = parser.parse_args(arguments)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    settings = get_settings()
    if options.command == "work":
        return _work(settings, options.name)
    settings.check(broker=False)
    return _serve(settings, options)


def _work(settings: Settings, name: str) -> int:
    from physworld_schemas.queues import INFERENCE
    from physworld_workers.app import run_worker

    settings.check()
    return run_worker(settings, INFERENCE, name)


def _serve(settings: Settings, options: argparse.Namespace) -> int:
    import uvicorn

    from physworld_services.connections import Session
    from physworld_services.inference.lazy import LazyApp
    from physworld_storage.access.tickets import TicketFilter

    config = uvicorn.Config(
        LazyApp(settings),
        host=options.host,
        port=options.port,
        log_level=settings.log_level,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws=Session,
        ws_max_size=2**20,
        timeout_graceful_shutdown=GRACE_S,
    )
    for handler in logging.getLogger("uvicorn").handlers:  # it logs the addresses of live sessions
        handler.addFilter(TicketFilter())
    server = uvicorn.Server(config)
    if options.fd is None:
        server.run()
        return 0 if server.started else 1
    with socket.socket(fileno=options.fd) as listening:
        server.run(sockets=[listening])
    return 0 if server.started else 1


if __name__ == "__main__":
    sys.exit(main())
