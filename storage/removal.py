"""Objects that people delete: the row goes, its files follow once nobody names them (``physworld_storage.orphans``).

Nothing goes that something else was made from, and nothing that a job is still making: the refusal names what stands in
the way. The jobs that made an object stay, as the log of what was done.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, delete, func, select, update
from sqlalchemy.orm import InstrumentedAttribute, Session

from physworld_schemas.job import TERMINAL_STATES
from physworld_storage import registry
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.tables import (
    AliasRow,
    AssessmentRow,
    Base,
    CheckRow,
    DatasetRow,
    EpisodeRow,
    FitRow,
    JobRow,
    ModelVersionRow,
    RunRow,
    SceneRow,
    ShardRow,
    TraceRow,
    VideoRow,
)

SHOWN = 3
"""Of what stands in the way, so many are named."""


@dataclass(frozen=True)
class Dependents:
    """Rows that were made from an object: of which kind, and how they name it."""

    kind: str
    key: InstrumentedAttribute[str]
    names: Callable[[str], ColumnElement[bool]]


@dataclass(frozen=True)
class Removable:
    """A kind of object that can be deleted by its id."""

    row: type[Base]
    dependents: tuple[Dependents, ...] = ()


def _by(kind: str, key: InstrumentedAttribute[str], column: InstrumentedAttribute[Any]) -> Dependents:
    return Dependents(kind, key, lambda object_id: column == object_id)


KINDS: dict[str, Removable] = {
    "scene": Removable(
        SceneRow,
        (
            _by("check", CheckRow.id, CheckRow.scene_id),
            _by("fit", FitRow.id, FitRow.scene_id),
            _by("trace", TraceRow.id, TraceRow.scene_id),
            _by("dataset", DatasetRow.id, DatasetRow.scene_id),
            _by("model", ModelVersionRow.name, ModelVersionRow.scene_id),
            _by("assessment", AssessmentRow.id, AssessmentRow.scene_id),
            _by("video", VideoRow.id, VideoRow.scene_id),
        ),
    ),
    "check": Removable(CheckRow),
    "fit": Removable(
        FitRow,
        (
            _by("trace", TraceRow.id, TraceRow.fit_id),
            _by("dataset", DatasetRow.id, DatasetRow.fit_id),
            _by("model", ModelVersionRow.name, ModelVersionRow.fit_id),
            _by("video", VideoRow.id, VideoRow.source_id),
        ),
    ),
    "trace": Removable(
        TraceRow,
        (
            _by("dataset", DatasetRow.id, DatasetRow.trace_id),
            _by("model", ModelVersionRow.name, ModelVersionRow.trace_id),
            _by("assessment", AssessmentRow.id, AssessmentRow.trace_id),
        ),
    ),
    "dataset": Removable(DatasetRow, (_by("model", ModelVersionRow.name, ModelVersionRow.dataset_id),)),
    "assessment": Removable(AssessmentRow),
    "rollout": Removable(RunRow, (_by("video", VideoRow.id, VideoRow.source_id),)),
    "plan": Removable(RunRow),
    "video": Removable(VideoRow),
}


def remove(session: Session, kind: str, object_id: str) -> None:
    """Delete an object of one of ``KINDS``.

    Raises NotFound, or Conflict when something was made from it or its job has not ended.
    """
    known = KINDS[kind]
    row = session.get(known.row, object_id)
    if row is None or (isinstance(row, RunRow) and row.kind != kind):
        raise NotFound(kind, object_id)
    _refuse_while_made(session, f"{kind} {object_id}", getattr(row, "job_id", None))
    _refuse_if_used(session, f"{kind} {object_id}", object_id, known.dependents)
    if kind == "dataset":
        session.execute(delete(EpisodeRow).where(EpisodeRow.dataset_id == object_id))
    _forget(session, row, getattr(row, "job_id", None))


def remove_version(session: Session, name: str, version: int) -> None:
    """Delete a version of a model; its number is never given again.

    Raises NotFound, or Conflict when an alias points at it, something was made with it or its job has not ended.
    """
    row = registry.version_row(session, name, version)
    what = f"version {version} of {name}"
    _refuse_while_made(session, what, row.job_id)
    _refuse_while_read(session, what, registry.reference_id(name, version))
    aliases = session.scalars(
        select(AliasRow.alias).where(AliasRow.name == name, AliasRow.version == version)
    ).all()
    if aliases:
        raise Conflict(f"{what} has the alias {', '.join(aliases)}; move or remove it first")
    made = (
        Dependents("run", RunRow.id, lambda _: (RunRow.model == name) & (RunRow.version == version)),
        Dependents(
            "assessment",
            AssessmentRow.id,
            lambda _: (AssessmentRow.name == name) & (AssessmentRow.version == version),
        ),
        Dependents(
            "video", VideoRow.id, lambda _: VideoRow.source_id == registry.reference_id(name, version)
        ),
    )
    _refuse_if_used(session, what, name, made)
    _forget(session, row, row.job_id)


def _forget(session: Session, row: Base, job_id: str | None) -> None:
    """Delete the row, and with it what its job's shards told of its files."""
    if job_id is not None:
        session.execute(update(ShardRow).where(ShardRow.job_id == job_id).values(result=None))
    session.delete(row)
    session.flush()


def _refuse_while_made(session: Session, what: str, job_id: str | None) -> None:
    job = None if job_id is None else session.get(JobRow, job_id)
    if job is not None and job.state not in TERMINAL_STATES:
        raise Conflict(f"{what} is being made by job {job.id}, which is {job.state}; cancel the job first")


def _refuse_while_read(session: Session, what: str, object_id: str) -> None:
    unended = session.scalars(select(JobRow).where(JobRow.state.not_in(TERMINAL_STATES)))
    job = next((job for job in unended if any(known["id"] == object_id for known in job.inputs)), None)
    if job is not None:
        raise Conflict(f"job {job.id}, which is {job.state}, needs {what}; cancel the job first")


def _refuse_if_used(session: Session, what: str, object_id: str, dependents: tuple[Dependents, ...]) -> None:
    for known in dependents:
        of = known.names(object_id)
        found = session.scalars(select(known.key).where(of).order_by(known.key).limit(SHOWN)).all()
        if found:
            count = session.scalar(select(func.count()).select_from(known.key.class_).where(of)) or 0
            more = f" and {count - len(found)} more" if count > len(found) else ""
            raise Conflict(f"{what} was used by {known.kind} {', '.join(found)}{more}; delete that first")
