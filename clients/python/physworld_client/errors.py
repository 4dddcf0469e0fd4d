"""The errors of the SDK, one tree.

    PhysWorldError
    ├── ConnectionFailed            no answer: nobody listens, or the line broke (after all retries)
    │   └── RequestTimedOut         the answer did not come within the timeout
    ├── ApiError                    the service said no; ``.problem`` is its RFC 9457 body
    │   ├── BadRequest              400
    │   ├── AuthenticationFailed    401  the token is missing or unknown
    │   ├── PermissionDenied        403  the key's role does not reach
    │   ├── NotFound                404, 410
    │   │   └── UnknownName         a text is no id and nothing is called that; ``.candidates``
    │   ├── Conflict                409
    │   ├── PayloadTooLarge         413
    │   ├── InvalidRequest          422, 415  ``.problem.errors`` names every fault with its place
    │   │   └── SceneInvalid        the code ``scene_invalid``: the validator's faults with their numbers
    │   ├── RateLimited             429
    │   └── ServerError             5xx
    ├── AmbiguousName               a text is no id and several objects are called that; ``.candidates``
    ├── JobFailed                   a job waited for has failed; ``.job``, ``.problem``
    ├── JobCancelled                a job waited for was cancelled; ``.job``
    ├── LiveSessionEnded            a live session is over; ``.code``, ``.reason`` of its WebSocket
    ├── WaitTimedOut                the job goes on, the caller's patience ended; ``.job``
    ├── DigestMismatch              bytes are not those that their SHA-256 promises; nothing was kept
    ├── ExportRefused               episodes cannot be written in that form or to that place: what, and why
    ├── NothingToPlot               an answer holds nothing that a plot could show, mostly since its job has not ended
    ├── ExtraMissing                a package is missing that an extra of this distribution brings; an ImportError too
    ├── BundleUnreadable            a local scene cannot be packed: the path, and what is wrong with it
    └── ModelUnreadable             a local model artifact is incomplete or of an unknown layout
        └── SignatureInvalid        its manifest is not signed, or was changed since; nothing was loaded
            └── SigningKeyUntrusted another key signed it than those trusted here: both fingerprints

``str(error)`` is one line that a person can act on. ``ApiError.problem.request_id`` finds the request in the
service's log.
"""

from __future__ import annotations

from http import HTTPStatus

from physworld_schemas.base import Problem
from physworld_schemas.job import Job

MAX_DETAIL_CHARACTERS = 500


class PhysWorldError(Exception):
    """Root of the tree."""


class ConnectionFailed(PhysWorldError):
    """No answer came: nobody listens at the address, or the connection broke."""


class RequestTimedOut(ConnectionFailed):
    """The answer did not come within the client's timeout."""


class ApiError(PhysWorldError):
    """The service answered with a problem."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        super().__init__(describe_problem(problem))

    @property
    def status(self) -> int:
        """HTTP status of the answer."""
        return self.problem.status

    @property
    def code(self) -> str:
        """The stable code of the problem, e.g. ``scene_invalid``."""
        return self.problem.code


class BadRequest(ApiError):
    """400."""


class AuthenticationFailed(ApiError):
    """401: the token is missing or unknown."""


class PermissionDenied(ApiError):
    """403: the key's role does not reach."""


class NotFound(ApiError):
    """404 or 410."""


class UnknownName(NotFound):
    """A text in the place of an id names nothing: neither an id nor the beginning of one, nor a name.

    Attributes:
        candidates: ids of what is called nearly so, or of the newest objects.
    """

    def __init__(self, text: str, candidates: tuple[str, ...]) -> None:
        super().__init__(Problem(title="Unknown name", status=404, code="not_found", detail=text))
        self.args = (text,)  # the service never saw it, so that a code and a request say nothing
        self.candidates = candidates


class AmbiguousName(PhysWorldError):
    """A text in the place of an id fits several objects.

    Attributes:
        candidates: their ids, newest first.
    """

    def __init__(self, text: str, candidates: tuple[str, ...]) -> None:
        super().__init__(text)
        self.candidates = candidates


class Conflict(ApiError):
    """409: the object's state forbids it."""


class PayloadTooLarge(ApiError):
    """413: the upload exceeds the service's limit."""


class InvalidRequest(ApiError):
    """422 or 415: the body does not fit; ``problem.errors`` names every fault."""


class SceneInvalid(InvalidRequest):
    """The scene did not pass the validator; ``problem.errors`` holds its faults with their numbers."""


class RateLimited(ApiError):
    """429, after all retries."""


class ServerError(ApiError):
    """5xx, after all retries."""


class JobFailed(PhysWorldError):
    """A job that was waited for has failed."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.problem = job.error
        reason = describe_problem(job.error) if job.error is not None else "no reason was recorded"
        super().__init__(f"{job.kind} job {job.id} failed: {reason}")


class JobCancelled(PhysWorldError):
    """A job that was waited for was cancelled."""

    def __init__(self, job: Job) -> None:
        self.job = job
        super().__init__(f"{job.kind} job {job.id} was cancelled")


class WaitTimedOut(PhysWorldError):
    """The wait ended before the job did; the job goes on."""

    def __init__(self, job: Job, timeout_s: float) -> None:
        self.job = job
        done = f"{job.progress.done:g} of {job.progress.total:g} {job.progress.unit}".strip()
        super().__init__(f"{job.kind} job {job.id} is still {job.state} ({done}) after {timeout_s:g} s")


class LiveSessionEnded(PhysWorldError):
    """A live session is over. ``code`` 1000: the client left; 1013: all sessions are taken; 4408: it was silent.

    1008: it was refused, and ``reason`` begins with a problem's code, e.g. ``model_unreadable``.
    """

    def __init__(self, code: int, reason: str) -> None:
        self.code, self.reason = code, reason
        super().__init__(f"the live session has ended ({code}): {reason or 'no reason was given'}")


class DigestMismatch(PhysWorldError):
    """The bytes are not those that their digest promises."""

    def __init__(self, what: str, expected: str, found: str) -> None:
        self.expected = expected
        self.found = found
        super().__init__(f"{what}: SHA-256 is {found}, expected {expected}")


class ExportRefused(PhysWorldError):
    """Episodes cannot be written in that form or to that place."""


class NothingToPlot(PhysWorldError):
    """An answer holds nothing that a plot could show."""

    def __init__(self, what: str) -> None:
        super().__init__(f"{what} holds nothing to plot yet")


class ExtraMissing(PhysWorldError, ImportError):
    """A package is missing that an extra of this distribution brings."""

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(f"{what} need an extra of this package: pip install 'physworld-client[{extra}]'")


class BundleUnreadable(PhysWorldError):
    """A local scene cannot be packed for the upload."""


class ModelUnreadable(PhysWorldError):
    """A local model artifact is incomplete or of an unknown layout."""


class SignatureInvalid(ModelUnreadable):
    """A manifest is not signed by a known key, or is not the one that was signed."""


class SigningKeyUntrusted(SignatureInvalid):
    """A manifest was signed by another key than those that are trusted.

    Attributes:
        service: that the files come from; None for a folder that was opened without one.
        signer: fingerprint of the key that signed, or its id where no list names it.
        trusted: fingerprints of the trusted keys.

    Args:
        text: the message.
        service: address that the version came from, if from one.
        signer: fingerprint of the key that signed.
        trusted: fingerprints of the keys that are trusted there.
    """

    def __init__(self, text: str, service: str | None, signer: str, trusted: tuple[str, ...]) -> None:
        self.service, self.signer, self.trusted = service, signer, trusted
        super().__init__(text)


_ERROR_OF_STATUS: dict[int, type[ApiError]] = {
    400: BadRequest,
    401: AuthenticationFailed,
    403: PermissionDenied,
    404: NotFound,
    409: Conflict,
    410: NotFound,
    413: PayloadTooLarge,
    415: InvalidRequest,
    422: InvalidRequest,
    429: RateLimited,
}


def describe_problem(problem: Problem) -> str:
    """One line of a problem: detail (or title), faults that it does not name, hint, code and request id."""
    text = problem.detail or problem.title
    for fault in problem.errors:
        if fault.msg not in text:
            place = ".".join(str(part) for part in fault.loc)
            text += f"; {place}: {fault.msg}" if place else f"; {fault.msg}"
    if problem.hint:
        text += f" ({problem.hint})"
    marks = [mark for mark in (problem.code, problem.request_id) if mark]
    return f"{text} [{', '.join(marks)}]" if marks else text


def error_from_response(status: int, content_type: str, body: bytes) -> ApiError:
    """The typed error of an answer with ``status`` of 400 or more.

    An answer that is not problem+json (a proxy's page) becomes a problem with the code ``http_<status>``.
    """
    problem = None
    if "json" in content_type:
        try:
            problem = Problem.model_validate_json(body)
        except ValueError:
            problem = None
    if problem is None:
        problem = Problem(
            title=_phrase(status),
            status=status,
            code=f"http_{status}",
            detail=" ".join(body.decode("utf-8", "replace").split())[:MAX_DETAIL_CHARACTERS],
        )
    if problem.code == "scene_invalid":
        return SceneInvalid(problem)
    if status >= 500:
        return ServerError(problem)
    return _ERROR_OF_STATUS.get(status, ApiError)(problem)


def _phrase(status: int) -> str:
    try:
        return HTTPStatus(status).phrase
    except ValueError:
        return f"HTTP status {status}"
