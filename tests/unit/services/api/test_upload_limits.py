"""Uploads of API and dashboard alike may have the size that the settings say, every other body a mebibyte."""

from __future__ import annotations

import asyncio

import httpx
import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

from physworld_services.api.limits import UPLOAD_PATHS, BodyLimit
from physworld_services.dashboard.site import BASE

LIMIT = 4 << 20
TWO_MEBIBYTES_OF_COMMAS = b"1," * (1 << 20)


def post(path: str, content: bytes) -> httpx.Response:
    async def counted(request: Request) -> JSONResponse:
        return JSONResponse({"bytes": len(await request.body())})

    async def sent() -> httpx.Response:
        app = Starlette(routes=[Route("/{path:path}", counted, methods=["POST"])])
        transport = httpx.ASGITransport(BodyLimit(app, LIMIT))
        async with httpx.AsyncClient(transport=transport, base_url="http://here") as client:
            return await client.post(path, content=content)

    return asyncio.run(sent())


@pytest.mark.parametrize("preview", ["", "/preview"])
@pytest.mark.parametrize("form", ["scenes", "trackings"])
@pytest.mark.parametrize("part", ["/v1", BASE])
def test_a_recording_of_two_mebibytes_comes_in(part: str, form: str, preview: str) -> None:
    path = f"{part}/{form}{preview}"
    assert path in UPLOAD_PATHS
    assert post(path, TWO_MEBIBYTES_OF_COMMAS).json() == {"bytes": 2 << 20}
    assert post(path, b"\0" * (LIMIT + (1 << 20))).status_code == 413


@pytest.mark.parametrize("path", ["/v1/fits", f"{BASE}/scenes/sample", f"{BASE}/fits"])
def test_other_bodies_have_a_mebibyte(path: str) -> None:
    assert post(path, TWO_MEBIBYTES_OF_COMMAS).status_code == 413
