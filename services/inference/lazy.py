"""The inference application, built at the first request: torch and Warp take seconds and hundreds of MB to load.

An installation that only fits and trains never pays for it.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from physworld_storage.settings import Settings

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Receive, Scope, Send


class LazyApp:
    """ASGI application that stands in for ``physworld_services.inference.app`` until somebody asks."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._app: ASGIApp | None = None
        self._lock = asyncio.Lock()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Build the application if need be, then hand over."""
        if scope["type"] == "lifespan":
            await receive()
            await send({"type": "lifespan.startup.complete"})
            await receive()
            await send({"type": "lifespan.shutdown.complete"})
            return
        async with self._lock:
            if self._app is None:
                self._app = await asyncio.to_thread(_build, self._settings)
        await self._app(scope, receive, send)


def _build(settings: Settings) -> ASGIApp:
    import torch

    from physworld_services.inference.app import create_app
    from physworld_services.stores import THREADS
    from physworld_storage.database import open_database
    from physworld_storage.patience import ANSWERING

    torch.set_num_threads(1)
    return create_app(settings, open_database(settings, threads=THREADS, patience=ANSWERING))
