"""The public keys by which clients verify published models."""

from __future__ import annotations

from fastapi import APIRouter

from physworld_schemas.base import Page
from physworld_schemas.signing import SigningKey
from physworld_services.api.dependencies import DatabaseDep, PageDep
from physworld_services.api.errors import documented
from physworld_storage import signing

router = APIRouter(prefix="/signing-keys", tags=["models"])


@router.get("", responses=documented(401, 403, 422))
def list_signing_keys(database: DatabaseDep, page: PageDep) -> Page[SigningKey]:
    """Every Ed25519 key that signs, or once signed, manifests of this service, newest first."""
    with database.reading() as session:
        return signing.list_signing_keys(session, limit=page.limit, cursor=page.cursor)
