"""API keys, for administrators.

A token is shown once, in the answer that creates it; a replay of that answer has no token, because the
service does not keep it.
"""

from __future__ import annotations

from fastapi import APIRouter, Response
from sqlalchemy.orm import Session

from schemas.base import Page
from schemas.key import ApiKey, KeyCreate
from services.api.dependencies import DatabaseDep, ObjectId, PageDep
from services.api.errors import documented
from services.api.idempotency import IdempotencyDep, answer_of
from storage import api_keys
from storage.idempotency import Answer

router = APIRouter(prefix="/keys", tags=["keys"])


@router.post("", status_code=201, response_model=ApiKey, responses=documented(401, 403, 409, 413, 422))
def create_key(body: KeyCreate, idempotency: IdempotencyDep) -> Response:
    """Make a key."""

    def work(session: Session) -> Answer:
        key, token = api_keys.create_key(session, body.name, body.role)
        return answer_of(201, _wire(key, token), {"Location": f"/v1/keys/{key.id}"})

    return idempotency.run(body, work, stored=_without_token)


@router.get("", responses=documented(401, 403, 422))
def list_keys(database: DatabaseDep, page: PageDep) -> Page[ApiKey]:
    """Keys, newest first, the revoked ones too."""
    with database.reading() as session:
        found = api_keys.list_keys(session, limit=page.limit, cursor=page.cursor)
    return Page(
        data=[_wire(key) for key in found.data], has_more=found.has_more, next_cursor=found.next_cursor
    )


@router.delete("/{key_id}", responses=documented(401, 403, 404, 422))
def revoke_key(key_id: ObjectId, database: DatabaseDep) -> ApiKey:
    """End a key. It stays in the list, with the time of its end."""
    with database.session() as session:
        return _wire(api_keys.revoke_key(session, key_id))


def _wire(key: api_keys.ApiKey, token: str | None = None) -> ApiKey:
    return ApiKey(
        id=key.id,
        name=key.name,
        role=key.role,
        created_at=key.created_at,
        revoked_at=key.revoked_at,
        token=token,
    )


def _without_token(answer: Answer) -> Answer:
    key = ApiKey.model_validate_json(answer.body)
    return answer_of(answer.status, key.model_copy(update={"token": None}), answer.headers)
