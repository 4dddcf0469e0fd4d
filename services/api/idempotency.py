"""``Idempotency-Key``: a POST that is sent twice works once and is answered twice.

Reservation, work and answer are one transaction. So a second request with the same key and body gets the
first answer again (``Idempotent-Replayed: true``), also when both run at the same time: the second waits for
the first. The same key with another body is 422 ``idempotency_key_reused``. A request that fails, or whose
process dies, leaves nothing behind and its key free. Keys belong to the API key that sent them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from fastapi import Depends, Header, Request, Response
from pydantic import BaseModel
from sqlalchemy.orm import Session

from physworld_schemas.job import Job
from physworld_services.api.dependencies import DatabaseDep, PrincipalDep
from physworld_storage import idempotency
from physworld_storage.database import Database
from physworld_storage.idempotency import Answer
from physworld_storage.jobs.kinds import MAKERS

RETRY_AFTER_S = "1"
JSON = "application/json"


Work = Callable[[Session], Answer]


def accepted(job: Job) -> Answer:
    """202: the work was accepted, and this is where to ask after it."""
    return answer_of(202, job_links(job), {"Location": f"/v1/jobs/{job.id}", "Retry-After": RETRY_AFTER_S})


def answer_of(status: int, model: BaseModel, headers: dict[str, str] | None = None) -> Answer:
    """A model as JSON, in the form in which it can be stored."""
    return Answer(status, headers or {}, model.model_dump_json().encode())


class Idempotency:
    """The Idempotency-Key of one request, or its absence.

    Args:
        database: keeps keys and answers.
        owner: of the key: the API key's id.
        method: of the request.
        path: of the request.
        key: as the client sent it; None for a request without one.
    """

    def __init__(self, database: Database, owner: str, method: str, path: str, key: str | None) -> None:
        self._database = database
        self._owner = owner
        self._method = method
        self._path = path
        self._key = key

    def run(
        self, subject: BaseModel | str, work: Work, stored: Callable[[Answer], Answer] | None = None
    ) -> Response:
        """Do ``work`` once for this key, and answer.

        ``subject`` is what the request asks for. ``stored`` makes the answer that is kept for a replay out of
        the one that is given now, where it must not be kept as it is.
        """
        with self._database.session() as session:
            if self._key is None:
                return _response(work(session))
            asked = subject if isinstance(subject, str) else subject.model_dump_json()
            fingerprint = idempotency.fingerprint(self._method, self._path, asked.encode())
            first = idempotency.reserve(session, self._owner, self._key, fingerprint)
            if first is not None:
                return _response(first, {"Idempotent-Replayed": "true"})
            answer = work(session)
            idempotency.record(session, self._owner, self._key, stored(answer) if stored else answer)
            return _response(answer)


def get_idempotency(
    request: Request,
    database: DatabaseDep,
    principal: PrincipalDep,
    key: Annotated[
        str | None,
        Header(
            alias="Idempotency-Key",
            min_length=1,
            max_length=128,
            pattern=r"^[\x21-\x7e]+$",
            description="repeat the request with the same key and it is done once",
        ),
    ] = None,
) -> Idempotency:
    """What a POST route runs its work through."""
    return Idempotency(database, principal.id, request.method, request.url.path, key)


IdempotencyDep = Annotated[Idempotency, Depends(get_idempotency)]


def job_links(job: Job) -> Job:
    """The job with the addresses that belong to it: itself, its events, what it reads and brings forth."""
    own = f"/v1/jobs/{job.id}"
    links = {"self": own, "events": f"{own}/events", "cancel": f"{own}/cancel"}
    for output in job.outputs:
        links[output.kind] = f"/v1/{MAKERS[output.kind].path(output.id)}"
    return job.model_copy(update={"links": links})


def _response(answer: Answer, more: dict[str, str] | None = None) -> Response:
    return Response(answer.body, answer.status, {**answer.headers, **(more or {})}, JSON)
