"""API keys, for administrators.

A token is shown once, in the answer that makes it; a replay of that answer has no token, because the service does
not keep it.
"""

from __future__ import annotations

from datetime import datetime, timedelta

from fastapi import APIRouter, Response
from sqlalchemy.orm import Session

from physworld_schemas.base import Page
from physworld_schemas.key import ApiKey, KeyCreate, KeyRotate
from physworld_services.api.dependencies import ActorDep, DatabaseDep, ObjectId, PageDep
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import IdempotencyDep, answer_of
from physworld_storage.access import api_keys
from physworld_storage.idempotency import Answer

router = APIRouter(prefix="/keys", tags=["keys"])


@router.post("", status_code=201, response_model=ApiKey, responses=documented(401, 403, 409, 413, 422))
def create_key(body: KeyCreate, idempotency: IdempotencyDep, actor: ActorDep) -> Response:
    """Make a key, for a year unless told otherwise."""

    def work(session: Session) -> Answer:
        days = body.expires_in_days
        key, token = api_keys.create_key(session, body.name, body.role, lifetime_days=days, by=actor)
        return answer_of(201, _wire(key, token), {"Location": f"/v1/keys/{key.id}"})

    return idempotency.run(body, work, stored=_without_token)


@router.get("", responses=documented(401, 403, 422))
def list_keys(database: DatabaseDep, page: PageDep) -> Page[ApiKey]:
    """Keys, newest first, the revoked and expired ones too."""
    with database.reading() as session:
        found = api_keys.list_keys(session, limit=page.limit, cursor=page.cursor)
    return Page(
        data=[_wire(key) for key in found.data], has_more=found.has_more, next_cursor=found.next_cursor
    )


@router.post("/{key_id}/rotate", response_model=ApiKey, responses=documented(401, 403, 404, 409, 413, 422))
def rotate_key(
    key_id: ObjectId, idempotency: IdempotencyDep, actor: ActorDep, body: KeyRotate | None = None
) -> Response:
    """Give a key another token, and its whole term again; the old token stays good for a while."""
    asked = body or KeyRotate()

    def work(session: Session) -> Answer:
        grace = timedelta(minutes=asked.grace_minutes)
        key, token, until = api_keys.rotate_key(session, key_id, grace, by=actor)
        return answer_of(200, _wire(key, token, until))

    return idempotency.run(asked, work, stored=_without_token)


@router.delete("/{key_id}", responses=documented(401, 403, 404, 409, 422))
def revoke_key(key_id: ObjectId, database: DatabaseDep, actor: ActorDep) -> ApiKey:
    """End a key and whatever it has open. It stays in the list; the admin key that lives longest cannot go."""
    with database.session() as session:
        return _wire(api_keys.revoke_key(session, key_id, by=actor))


def _wire(key: api_keys.ApiKey, token: str | None = None, old_token_until: datetime | None = None) -> ApiKey:
    return ApiKey(
        id=key.id,
        name=key.name,
        role=key.role,
        created_at=key.created_at,
        expires_at=key.expires_at,
        revoked_at=key.revoked_at,
        token=token,
        old_token_until=old_token_until,
    )


def _without_token(answer: Answer) -> Answer:
    key = ApiKey.model_validate_json(answer.body)
    return answer_of(answer.status, key.model_copy(update={"token": None}), answer.headers)
