"""The audit log, for administrators."""

from __future__ import annotations

from fastapi import APIRouter

from physworld_schemas.audit import AuditEntry
from physworld_schemas.base import Page
from physworld_services.api.dependencies import DatabaseDep, PageDep
from physworld_services.api.errors import documented
from physworld_storage.access import audit

router = APIRouter(prefix="/audit", tags=["keys"])


@router.get("", responses=documented(401, 403, 422))
def list_audit(database: DatabaseDep, page: PageDep) -> Page[AuditEntry]:
    """What was done to keys, logins, jobs and aliases, by which key and from where, newest first."""
    with database.reading() as session:
        return audit.list_entries(session, limit=page.limit, cursor=page.cursor)
