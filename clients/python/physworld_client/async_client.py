"""The client: connection, retries, and the resources as attributes."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import httpx

from physworld_client import transport as wire
from physworld_client.async_artifacts import AsyncArtifacts
from physworld_client.async_keys import AsyncKeys
from physworld_client.async_live import AsyncLive
from physworld_client.async_loop import AsyncAssessments, AsyncChecks, AsyncLoops, AsyncTraces
from physworld_client.async_predict import AsyncPlans, AsyncRollouts
from physworld_client.async_resources import (
    AsyncDatasets,
    AsyncFits,
    AsyncJobs,
    AsyncModels,
    AsyncPipelines,
    AsyncScenes,
    AsyncTrackings,
)
from physworld_client.async_videos import AsyncVideos
from physworld_client.calls import Call
from physworld_client.known_keys import KnownKeys
from physworld_client.location import where
from physworld_client.progress import Bars

Answer = TypeVar("Answer")


class AsyncClient:
    """A connection to one PhysWorld service; usable as a context manager.

    Args:
        base_url: address of the service; without it ``PHYSWORLD_URL``, else the embedded service that runs on
            ``PHYSWORLD_DATA_DIR`` or the usual data folder.
        token: API key; without it ``PHYSWORLD_TOKEN``, or the embedded service's own.
        timeout: seconds for one answer (a long poll adds its own wait).
        max_retries: further attempts after the first, see ``physworld_client.transport``.
        transport: a transport of httpx, for tests or a Unix socket.
        known_keys: the file of keys that may sign models; by default that of this machine.
        known_as: the service's name in that file; its address without it.
        progress: whether uploads and downloads show a bar on the standard error stream; by default where that is a
            terminal.

    Attributes:
        scenes, trackings, checks, fits, traces, datasets, models, assessments, loops, rollouts, plans, videos, live,
        jobs, keys, pipelines, artifacts:
            the resources.
    """

    def __init__(
        self,
        base_url: str | None = None,
        token: str | None = None,
        timeout: float = wire.DEFAULT_TIMEOUT_S,
        max_retries: int = wire.DEFAULT_MAX_RETRIES,
        *,
        transport: httpx.AsyncBaseTransport | None = None,
        known_keys: str | Path | None = None,
        known_as: str | None = None,
        progress: bool | None = None,
    ) -> None:
        found = where(base_url, token)
        self.timeout = timeout
        self.max_retries = max_retries
        self.bars = Bars(progress)
        self.known_keys = KnownKeys(known_keys)
        self.http = httpx.AsyncClient(
            transport=transport, **wire.client_options(found.url, found.token, timeout)
        )
        self.known_as = known_as or found.known_as or wire.service_name(self.base_url)
        self.scenes = AsyncScenes(self)
        self.trackings = AsyncTrackings(self)
        self.fits = AsyncFits(self)
        self.checks = AsyncChecks(self)
        self.traces = AsyncTraces(self)
        self.datasets = AsyncDatasets(self)
        self.models = AsyncModels(self)
        self.assessments = AsyncAssessments(self)
        self.loops = AsyncLoops(self)
        self.rollouts = AsyncRollouts(self)
        self.plans = AsyncPlans(self)
        self.videos = AsyncVideos(self)
        self.live = AsyncLive(self)
        self.jobs = AsyncJobs(self)
        self.keys = AsyncKeys(self)
        self.pipelines = AsyncPipelines(self)
        self.artifacts = AsyncArtifacts(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.base_url!r})"

    @property
    def base_url(self) -> str:
        """Address of the service, without a slash at its end."""
        return str(self.http.base_url).rstrip("/")

    async def send(self, call: Call[Answer]) -> Answer:
        """Sends a call with its retries and returns its typed answer, or raises the typed error."""
        key = wire.new_key()
        retry = wire.Retry(self.max_retries)
        while True:
            request = wire.build_request(self.http, call, key, self.timeout)
            try:
                response = await self.http.send(request)
            except httpx.TransportError as error:
                if not retry.again():
                    raise wire.connection_error(error, self.http, retry) from error
                await asyncio.sleep(retry.delay_s())
                continue
            if response.status_code in wire.RETRIED_STATUSES and retry.again():
                await asyncio.sleep(retry.delay_s(response))
                continue
            answer: Answer = wire.read_answer(call, response)
            return answer

    async def close(self) -> None:
        """Closes the connections."""
        await self.http.aclose()

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()
