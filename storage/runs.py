"""Rollouts and plans: what a model version was asked, and what it answered."""

from __future__ import annotations

from typing import Any, Literal, TypeVar

from pydantic import BaseModel
from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.base import Artifact, Lineage, Page
from physworld_schemas.plan import Plan
from physworld_schemas.rollout import Rollout
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.pages import page_of
from physworld_storage.rows import chosen, plain
from physworld_storage.search import matching
from physworld_storage.tables import RunRow, columns_of

RunKind = Literal["rollout", "plan"]
Wire = TypeVar("Wire", Rollout, Plan)
REQUEST = "request.json"
RESULT = {"rollout": "rollout.npz", "plan": "plan.npz"}


def get_rollout(session: Session, rollout_id: str) -> Rollout:
    """The rollout, or NotFound."""
    return _wire(Rollout, run_row(session, "rollout", rollout_id))


def get_plan(session: Session, plan_id: str) -> Plan:
    """The plan, or NotFound."""
    return _wire(Plan, run_row(session, "plan", plan_id))


def list_rollouts(
    session: Session, *, limit: int = 50, cursor: str | None = None, model: str | None = None
) -> Page[Rollout]:
    """Rollouts that were jobs, newest first.

    Args:
        session: the transaction that reads.
        limit: most rollouts of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        model: only rollouts of this model.

    Raises:
        InvalidCursor: no list of rollouts gave this cursor out.
    """
    return _page(session, "rollout", Rollout, limit, cursor, model)


def list_plans(
    session: Session, *, limit: int = 50, cursor: str | None = None, model: str | None = None
) -> Page[Plan]:
    """Plans, newest first.

    Args:
        session: the transaction that reads.
        limit: most plans of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        model: only plans with this model.

    Raises:
        InvalidCursor: no list of plans gave this cursor out.
    """
    return _page(session, "plan", Plan, limit, cursor, model)


def get_run(session: Session, kind: RunKind, run_id: str) -> Rollout | Plan:
    """The rollout or plan, or NotFound."""
    return get_rollout(session, run_id) if kind == "rollout" else get_plan(session, run_id)


def list_runs(
    session: Session,
    kind: RunKind,
    *,
    limit: int = 50,
    cursor: str | None = None,
    model: str | None = None,
    search: str | None = None,
) -> Page[Rollout] | Page[Plan]:
    """Rollouts or plans, newest first.

    Args:
        session: the transaction that reads.
        kind: ``rollout`` or ``plan``.
        limit: most runs of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        model: only runs of this model.
        search: words that an id, a state or a model's name holds.

    Raises:
        InvalidCursor: no list of this kind gave this cursor out.
    """
    if kind == "rollout":
        return _page(session, kind, Rollout, limit, cursor, model, search)
    return _page(session, kind, Plan, limit, cursor, model, search)


def mark_run_ready(
    session: Session,
    kind: RunKind,
    run_id: str,
    figures: dict[str, Any],
    artifacts: list[Artifact],
    lineage: Lineage,
) -> None:
    """Fill in a pending run.

    Args:
        session: the transaction that commits the shard.
        kind: ``rollout`` or ``plan``.
        run_id: of a pending one.
        figures: what it says beside its files, as JSON.
        artifacts: its files, which join that of the request.
        lineage: inputs, seeds and versions.

    Raises:
        NotFound: there is no such run.
        Conflict: it is not pending.
    """
    row = run_row(session, kind, run_id)
    if row.state != "pending":
        raise Conflict(f"{kind} {run_id} is {row.state}; only a pending one can become ready")
    row.state = "ready"
    row.figures = figures
    row.artifacts = [*row.artifacts, *plain(artifacts)]
    row.lineage = lineage.model_dump(mode="json")
    session.flush()


def run_digest(artifacts: list[Artifact], kind: RunKind) -> str | None:
    """The digest by which others refer to a run: that of its arrays."""
    return next((item.sha256 for item in artifacts if item.name == RESULT[kind]), None)


def run_row(session: Session, kind: RunKind, run_id: str) -> RunRow:
    """The row, or NotFound."""
    row = session.get(RunRow, run_id)
    if row is None or row.kind != kind:
        raise NotFound(kind, run_id)
    return row


def _page(
    session: Session,
    kind: RunKind,
    wire: type[Wire],
    limit: int,
    cursor: str | None,
    model: str | None,
    search: str | None = None,
) -> Page[Wire]:
    statement = select(RunRow).where(RunRow.kind == kind)
    statement = matching(statement, search, RunRow.id, RunRow.model, RunRow.state)
    statement = chosen(statement, (RunRow.model, model))
    keys = (RunRow.created_at, RunRow.id)
    return page_of(session, statement, keys, lambda row: _wire(wire, row), limit=limit, cursor=cursor)


def _wire(wire: type[Wire], row: RunRow) -> Wire:
    columns = columns_of(row)
    answer: BaseModel = wire.model_validate({**columns.pop("figures"), **columns})
    assert isinstance(answer, wire)
    return answer
