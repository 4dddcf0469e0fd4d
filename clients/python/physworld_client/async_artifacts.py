"""The service's artifacts: content-addressed files that are downloaded."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

import httpx

from physworld_client import transport
from physworld_client.calls import route
from physworld_client.partial import PartialFile
from physworld_client.progress import Bar
from physworld_schemas.base import Artifact

if TYPE_CHECKING:
    from physworld_client.async_client import AsyncClient


class AsyncArtifacts:
    """Content-addressed files."""

    def __init__(self, client: AsyncClient) -> None:
        self._client = client

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self._client.base_url}>"

    async def download(self, artifact: Artifact | str, path: str | Path) -> Path:
        """Downloads an artifact to ``path``: resumes a part found there, checks the digest, then renames.

        Several downloads of one file to one place may run at once, in threads or processes.

        Raises:
            DigestMismatch: the bytes are not those of the digest; nothing was put at ``path``.
        """
        partial = PartialFile(Path(path), artifact.sha256 if isinstance(artifact, Artifact) else artifact)
        if partial.present():
            return partial.target
        with partial, self._client.bars.receiving(partial.target.name) as bar:
            await self._fill(partial, bar)
            return partial.finish()

    async def _fill(self, partial: PartialFile, bar: Bar) -> None:
        """Requests with retries until the part holds every byte."""
        retry = transport.Retry(self._client.max_retries)
        while not partial.complete():
            offset = partial.offset
            try:
                response = await self._fetch(partial, bar)
            except httpx.TransportError as error:
                if partial.offset > offset:
                    retry.attempt = 0
                if not retry.again():
                    raise transport.connection_error(error, self._client.http, retry) from error
                await asyncio.sleep(retry.delay_s())
                continue
            if response.is_success:
                return
            if partial.refused(response):
                continue
            if response.status_code not in transport.RETRIED_STATUSES or not retry.again():
                transport.raise_for_problem(response)
            await asyncio.sleep(retry.delay_s(response))

    async def _fetch(self, partial: PartialFile, bar: Bar) -> httpx.Response:
        """One request for what is missing; the body of a success is in the part when this returns."""
        path = route("artifacts", partial.sha256)
        async with self._client.http.stream("GET", path, headers=partial.headers()) as response:
            if response.is_success:
                partial.accept(response)
                bar.begins(partial.offset, response.headers.get("content-length"))
                async for chunk in response.aiter_bytes():
                    partial.write(chunk)
                    bar.moves(len(chunk))
            else:
                await response.aread()
        return response
