"""Logs as one JSON object per line on standard error, ours and those of the libraries alike."""

from __future__ import annotations

import logging
import sys
from typing import Any

import structlog

from physworld_storage.access.tickets import hide_tickets


def _hide_tickets(logger: Any, name: str, entry: structlog.typing.EventDict) -> structlog.typing.EventDict:
    """No line holds a ticket, which stands in the addresses of live sessions."""
    return {key: hide_tickets(value) if isinstance(value, str) else value for key, value in entry.items()}


_SHARED: list[structlog.typing.Processor] = [
    structlog.contextvars.merge_contextvars,
    structlog.stdlib.add_log_level,
    structlog.stdlib.add_logger_name,
    structlog.processors.TimeStamper(fmt="iso", utc=True),
]


def configure_logs(level: str) -> None:
    """Set up structlog and the standard library's logging; ``level`` as in the settings."""
    structlog.configure(
        processors=[*_SHARED, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()]),
        cache_logger_on_first_use=True,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=_SHARED,
            processors=[
                structlog.stdlib.ProcessorFormatter.remove_processors_meta,
                structlog.processors.format_exc_info,
                _hide_tickets,
                structlog.processors.JSONRenderer(),
            ],
        )
    )
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    for name in ("uvicorn", "uvicorn.error"):
        logging.getLogger(name).handlers.clear()
    for name in (
        "uvicorn.error",
        "websockets",
    ):  # below that they write whole requests, keys and cookies included
        logging.getLogger(name).setLevel(max(root.level, logging.INFO))
    # The access middleware writes these lines, with the request id.
    logging.getLogger("uvicorn.access").disabled = True
