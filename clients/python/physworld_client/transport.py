"""What both clients share below the resources: addresses, headers, requests, retries.

Retries. A connection error, a timeout or one of ``RETRIED_STATUSES`` is tried again up to ``max_retries``
times, after ``Retry-After`` when the service names it (at most ``RETRY_AFTER_LIMIT_S``), else after a
jittered exponential delay. Every POST carries an ``Idempotency-Key`` that stays the same over its retries, so
that a repeated POST can never start the work twice.
"""

from __future__ import annotations

import ipaddress
import random
import uuid
from dataclasses import dataclass, field
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any

import httpx
from pydantic import TypeAdapter, ValidationError

from physworld_client.calls import Call
from physworld_client.errors import (
    ConnectionFailed,
    PhysWorldError,
    RequestTimedOut,
    error_from_response,
)
from physworld_schemas.wording import reason

RETRIED_STATUSES = frozenset({408, 425, 429, 500, 502, 503, 504})  # not 507: a store that is full stays so
RETRY_BASE_S = 0.25
RETRY_LIMIT_S = 8.0
RETRY_AFTER_LIMIT_S = 60.0
LONG_POLL_MARGIN_S = 10.0
DEFAULT_TIMEOUT_S = 30.0
DEFAULT_MAX_RETRIES = 4
USER_AGENT = "physworld-client/0.2.0"


@dataclass
class Retry:
    """The attempts of one request: how many are left and how long to pause before the next."""

    max_retries: int
    attempt: int = 0
    random: random.Random = field(default_factory=random.Random)

    def again(self) -> bool:
        """Whether one more attempt is allowed; counts it."""
        if self.attempt >= self.max_retries:
            return False
        self.attempt += 1
        return True

    def delay_s(self, response: httpx.Response | None = None) -> float:
        """Seconds to pause before the attempt just allowed."""
        if response is not None:
            asked = retry_after_s(response.headers.get("retry-after"))
            if asked is not None and asked <= RETRY_AFTER_LIMIT_S:
                return asked
        ceiling = min(RETRY_BASE_S * 2.0**self.attempt, RETRY_LIMIT_S)
        return ceiling * self.random.uniform(0.5, 1.0)


def retry_after_s(header: str | None) -> float | None:
    """Seconds of a ``Retry-After`` header (a number or an HTTP date); None when absent or unreadable."""
    if header is None:
        return None
    try:
        return max(0.0, float(header))
    except ValueError:
        pass
    try:
        moment = parsedate_to_datetime(header)
    except ValueError:
        return None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return max(0.0, (moment - datetime.now(UTC)).total_seconds())


def is_loopback(url: str) -> bool:
    """Whether the address stays on this machine; proxies of the environment must not capture it."""
    try:
        host = httpx.URL(url).host
    except httpx.InvalidURL as error:
        raise PhysWorldError(f"{url!r} is not an address: {error}") from error
    if host == "localhost" or host.endswith(".localhost"):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def service_name(base_url: str) -> str:
    """What a service is called where its keys are pinned: its address, without what lets somebody in."""
    return str(httpx.URL(base_url).copy_with(username=None, password=None)).rstrip("/")


def client_options(base_url: str, token: str | None, timeout: float) -> dict[str, Any]:
    """Keyword arguments common to ``httpx.Client`` and ``httpx.AsyncClient``."""
    if not base_url.startswith(("http://", "https://")):
        raise PhysWorldError(f"{base_url!r} is not an http address")
    headers = {"User-Agent": USER_AGENT, "Accept": "application/json"}
    if token:
        headers["Authorization"] = f"Bearer {token}"
    return {
        "base_url": base_url,
        "headers": headers,
        "timeout": httpx.Timeout(timeout, connect=min(timeout, 10.0)),
        "trust_env": not is_loopback(base_url),
        "follow_redirects": True,
    }


def build_request(
    http: httpx.Client | httpx.AsyncClient, call: Call[Any], key: str, timeout: float
) -> httpx.Request:
    """The HTTP request of a call. The multipart boundary comes from the key: a retry sends the same bytes.

    Args:
        http: makes the request with its base address and headers.
        call: method, path, body and upload.
        key: the Idempotency-Key of a POST and the boundary of an upload.
        timeout: of connecting and of every wait [s]; a call that answers late has a longer one of its own.
    """
    headers: dict[str, str] = {}
    options: dict[str, Any] = {}
    if call.method == "POST":
        headers["Idempotency-Key"] = key
    if call.body is not None:
        headers["Content-Type"] = "application/json"
        options["content"] = call.body.model_dump_json(exclude_unset=True).encode()
    if call.upload is not None:
        call.upload.stream.seek(0)
        headers["Content-Type"] = f"multipart/form-data; boundary={key}"
        options["files"] = {"bundle": (call.upload.filename, call.upload.stream, call.upload.media_type)}
        options["data"] = dict(call.form)
    if call.read_timeout_s:
        read = max(timeout, call.read_timeout_s + LONG_POLL_MARGIN_S)
        options["timeout"] = httpx.Timeout(timeout, read=read, connect=min(timeout, 10.0))
    return http.build_request(
        call.method, call.path, params=dict(call.query) or None, headers=headers, **options
    )


def new_key() -> str:
    """A new idempotency key."""
    return uuid.uuid4().hex


def read_answer(call: Call[Any], response: httpx.Response) -> Any:
    """The typed answer of a call, or the typed error."""
    raise_for_problem(response)
    if call.answer is bytes:
        return response.content
    try:
        return TypeAdapter(call.answer).validate_json(response.content)
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(str(part) for part in fault["loc"])
        raise PhysWorldError(
            f"{call.method} {response.request.url} answered {len(response.content)} bytes that this client "
            f"cannot read ({error.error_count()} faults; first at {place or 'the root'}: {fault['msg']})"
        ) from error


def raise_for_problem(response: httpx.Response) -> None:
    """Raises the typed error of an answer of 400 or more, whose body has been read."""
    if response.status_code >= 400:
        content_type = response.headers.get("content-type", "")
        raise error_from_response(response.status_code, content_type, response.content)


def connection_error(
    error: httpx.TransportError, http: httpx.Client | httpx.AsyncClient, retry: Retry
) -> ConnectionFailed:
    """The SDK's error of a transport error, with the address and the number of attempts."""
    attempts = retry.attempt + 1
    base_url = str(http.base_url).rstrip("/")
    tries = f"{attempts} attempt{'s' if attempts != 1 else ''}"
    if isinstance(error, httpx.TimeoutException):
        return RequestTimedOut(f"{base_url} did not answer in time ({tries})")
    return ConnectionFailed(f"no connection to {base_url}: {reason(error)} ({tries})")


def stream_ended(
    error: httpx.TransportError | None, http: httpx.Client | httpx.AsyncClient, retry: Retry
) -> ConnectionFailed:
    """The SDK's error of an event stream that breaks off, or is closed, again and again without an event."""
    if error is not None:
        return connection_error(error, http, retry)
    return ConnectionFailed(
        f"{http.base_url} closed the event stream {retry.attempt + 1} times without an event"
    )
