"""Questions that only people ask: how much there is, what runs at the top level, what a job is about.

Read-only, a handful of statements each, so that a page over thousands of jobs costs what one over ten does.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sqlalchemy import func, select
from sqlalchemy.orm import InstrumentedAttribute, Session

from physworld_schemas.base import Page
from physworld_schemas.job import TERMINAL_STATES, Event, Job
from physworld_storage.jobs.kinds import KINDS
from physworld_storage.pages import page_of
from physworld_storage.rows import chosen
from physworld_storage.search import matching_jobs
from physworld_storage.tables import (
    DatasetRow,
    EventRow,
    FitRow,
    JobRow,
    ModelRow,
    SceneRow,
    columns_of,
)


@dataclass(frozen=True)
class Counts:
    """How many of each there are; ``active_jobs`` are those of the top level that have not ended."""

    active_jobs: int
    scenes: int
    datasets: int
    models: int


def count_objects(session: Session) -> Counts:
    """The numbers that the overview begins with."""
    ended = JobRow.state.in_(sorted(TERMINAL_STATES))
    active = select(func.count()).select_from(JobRow).where(JobRow.parent_id.is_(None), ~ended)
    return Counts(
        active_jobs=session.scalar(active) or 0,
        scenes=_count(session, SceneRow.id),
        datasets=_count(session, DatasetRow.id),
        models=_count(session, ModelRow.name),
    )


def list_top_jobs(
    session: Session,
    *,
    limit: int = 50,
    cursor: str | None = None,
    state: str | None = None,
    search: str | None = None,
) -> Page[Job]:
    """Jobs that no pipeline owns, newest first. ``children`` is left empty: ``children_of`` gives them.

    Args:
        session: the transaction that reads.
        limit: most jobs of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        state: only jobs of this state.
        search: words that a job or what it is about holds.

    Raises:
        InvalidCursor: no list of jobs gave this cursor out.
    """
    statement = matching_jobs(select(JobRow).where(JobRow.parent_id.is_(None)), search)
    statement = chosen(statement, (JobRow.state, state))
    keys = (JobRow.created_at, JobRow.id)
    return page_of(session, statement, keys, _job, limit=limit, cursor=cursor)


def children_of(session: Session, jobs: Iterable[Job]) -> dict[str, list[Job]]:
    """The children of these jobs by parent, each list in the order of the stages."""
    parents = [job.id for job in jobs if KINDS[job.kind].has_children]
    order = (JobRow.created_at, JobRow.id)
    children: dict[str, list[Job]] = {parent: [] for parent in parents}
    if not parents:
        return children
    for row in session.scalars(select(JobRow).where(JobRow.parent_id.in_(parents)).order_by(*order)):
        children[str(row.parent_id)].append(_job(row))
    return children


def subjects_of(session: Session, jobs: Sequence[Job]) -> dict[str, str]:
    """What each job is about, by job: the model that it trains, else the name of its scene."""
    inputs = {job.id: job.inputs[0] for job in jobs if job.inputs}
    names = scene_names(session, {item.id for item in inputs.values() if item.kind == "scene"})
    for kind, table in (("fit", FitRow), ("dataset", DatasetRow)):
        wanted = {item.id for item in inputs.values() if item.kind == kind}
        if wanted:
            statement = select(table.id, SceneRow.name).join(SceneRow, SceneRow.id == table.scene_id)
            names.update((row[0], row[1]) for row in session.execute(statement.where(table.id.in_(wanted))))
    subjects = {job_id: names[item.id] for job_id, item in inputs.items() if item.id in names}
    subjects.update({job_id: item.id for job_id, item in inputs.items() if item.kind == "model"})
    own = ((job.id, KINDS[job.kind].subject(job)) for job in jobs)
    return subjects | {job_id: subject for job_id, subject in own if subject is not None}


def scene_names(session: Session, scene_ids: Iterable[str]) -> dict[str, str]:
    """Names of scenes by id."""
    wanted = set(scene_ids)
    if not wanted:
        return {}
    rows = session.execute(select(SceneRow.id, SceneRow.name).where(SceneRow.id.in_(wanted)))
    return {row.id: row.name for row in rows}


def latest_events(session: Session, job_ids: Sequence[str], limit: int = 100) -> list[Event]:
    """The newest events of these jobs, newest first."""
    statement = (
        select(EventRow).where(EventRow.job_id.in_(job_ids)).order_by(EventRow.seq.desc()).limit(limit)
    )
    return [
        Event(seq=row.seq, job_id=row.job_id, type=row.type, at=row.at, data=row.data)
        for row in session.scalars(statement)
    ]


def _count(session: Session, column: InstrumentedAttribute[str]) -> int:
    return session.scalar(select(func.count(column))) or 0


def _job(row: JobRow) -> Job:
    return Job.model_validate(columns_of(row))
