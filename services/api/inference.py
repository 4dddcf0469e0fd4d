"""The inference service behind the API: small rollouts are asked of it and answered at once."""

from __future__ import annotations

import httpx

from physworld_schemas.base import FieldError
from physworld_schemas.rollout import Rollout, RolloutCreate
from physworld_schemas.wording import reason
from physworld_services.api.errors import ApiProblem
from physworld_storage.access import tickets
from physworld_storage.database import Database

TIMEOUT_S = 60.0
TICKET_HEADER = "X-Physworld-Ticket"
_HINT = (
    'the inference service answers small rollouts and live sessions; "mode": "job" queues a rollout instead'
)


def roll_out(url: str, database: Database, credential: str, request: RolloutCreate) -> Rollout:
    """The answer of the inference service at ``url``.

    Args:
        url: of the inference service.
        database: gives out the ticket.
        credential: of the caller, as ``ApiKey.credential``.
        request: as the API got it.

    Raises:
        ApiProblem: the inference service's own, or 503 where it does not answer.
    """
    with database.session() as session:
        ticket, _ = tickets.issue(session, credential, f"rollout:{request.model}:{request.version}")
    try:
        answer = httpx.post(
            f"{url}/rollouts",
            content=request.model_dump_json(),
            headers={TICKET_HEADER: ticket, "Content-Type": "application/json"},
            timeout=TIMEOUT_S,
            trust_env=False,
        )
    except httpx.TransportError as error:
        raise unavailable(f"the inference service does not answer: {reason(error)}") from error
    if answer.status_code == 200:
        return Rollout.model_validate_json(answer.content)
    if answer.headers.get("Content-Type", "").startswith("application/problem+json"):
        problem = answer.json()
        faults = [FieldError.model_validate(item) for item in problem.get("errors", [])]
        if answer.status_code != 401:
            later = answer.headers.get("Retry-After")
            headers = None if later is None else {"Retry-After": later}
            raise ApiProblem(
                answer.status_code, problem["code"], problem["detail"], errors=faults, headers=headers
            )
    raise unavailable(f"the inference service answered {answer.status_code}")


def unavailable(detail: str) -> ApiProblem:
    """503, with what to do meanwhile."""
    return ApiProblem(503, "inference_unavailable", detail, hint=_HINT, headers={"Retry-After": "5"})
