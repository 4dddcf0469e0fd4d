"""Traces and assessments: rows in, wire models out; born pending, filled in by the commit of their shard."""

from __future__ import annotations

from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.assessment import Assessment
from physworld_schemas.base import Artifact, Lineage, Page
from physworld_schemas.trace import Trace
from physworld_storage.pages import page_of
from physworld_storage.rows import chosen, pending, plain, required
from physworld_storage.search import matching
from physworld_storage.tables import AssessmentRow, FitRow, TraceRow, columns_of

TWIN = "twin.npz"
TRACKS = "tracks.npz"
REPORT = "report.json"
PAGE = "report.html"
DECLARED = "declared.npz"


def get_trace(session: Session, trace_id: str) -> Trace:
    """The trace, or NotFound."""
    return _trace(required(session, TraceRow, trace_id))


def list_traces(
    session: Session,
    *,
    limit: int = 50,
    cursor: str | None = None,
    state: str | None = None,
    scene_id: str | None = None,
    verdict: str | None = None,
    search: str | None = None,
) -> Page[Trace]:
    """Traces, newest first.

    Args:
        session: the transaction that reads.
        limit: most traces of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        state: only traces of this state.
        scene_id: only traces of this scene.
        verdict: only traces with this answer.
        search: words that an id, a state, a verdict or the scene's name holds.

    Raises:
        InvalidCursor: no list of traces gave this cursor out.
    """
    columns = (TraceRow.id, TraceRow.state, TraceRow.verdict)
    statement = matching(select(TraceRow), search, *columns, scene_id=TraceRow.scene_id)
    filters = ((TraceRow.state, state), (TraceRow.scene_id, scene_id), (TraceRow.verdict, verdict))
    statement = chosen(statement, *filters)
    return page_of(session, statement, (TraceRow.created_at, TraceRow.id), _trace, limit=limit, cursor=cursor)


def mark_trace_ready(
    session: Session,
    trace_id: str,
    verdict: str,
    report: dict[str, Any],
    artifacts: list[Artifact],
    lineage: Lineage,
) -> None:
    """Fill in a pending trace.

    Args:
        session: the transaction that commits the shard.
        trace_id: of a pending trace.
        verdict: its answer in one word.
        report: the whole answer, as JSON; what the pending one holds stays where it has no such key.
        artifacts: twin, predictions and report.
        lineage: inputs, seeds and versions.

    Raises:
        NotFound: there is no such trace.
        Conflict: it is not pending.
    """
    row = pending(session, TraceRow, trace_id)
    row.state = "ready"
    row.verdict = verdict
    row.report = {**row.report, **report}  # a pending one holds the other recordings
    row.artifacts = plain(artifacts)
    row.lineage = lineage.model_dump(mode="json")
    session.flush()


def leaves_twin(trace: Trace | TraceRow) -> bool:
    """Whether the trace left a twin with an effect: one that is named, or the best of an equivalent set."""
    names = [item["name"] if isinstance(item, dict) else item.name for item in trace.artifacts]
    return trace.state == "ready" and TWIN in names


def fit_digest(fit: FitRow) -> str | None:
    """The digest by which others refer to a fit: that of its twin."""
    return _digest(fit.artifacts, TWIN)


def trace_digest(trace: TraceRow) -> str | None:
    """The digest by which others refer to a trace: that of its report."""
    return _digest(trace.artifacts, REPORT)


def get_assessment(session: Session, assessment_id: str) -> Assessment:
    """The assessment, or NotFound."""
    return _assessment(required(session, AssessmentRow, assessment_id))


def list_assessments(
    session: Session,
    name: str | None = None,
    version: int | None = None,
    *,
    limit: int = 50,
    cursor: str | None = None,
) -> Page[Assessment]:
    """Assessments, newest first.

    Args:
        session: the transaction that reads.
        name: only those of this model; None: of all.
        version: only those of this number; None: of all.
        limit: most assessments of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.

    Raises:
        InvalidCursor: no list of assessments gave this cursor out.
    """
    statement = chosen(select(AssessmentRow), (AssessmentRow.name, name), (AssessmentRow.version, version))
    keys = (AssessmentRow.created_at, AssessmentRow.id)
    return page_of(session, statement, keys, _assessment, limit=limit, cursor=cursor)


def mark_assessment_ready(
    session: Session, assessment_id: str, figures: dict[str, Any], lineage: Lineage
) -> AssessmentRow:
    """Fill in a pending assessment.

    Args:
        session: the transaction that commits the shard.
        assessment_id: of a pending assessment.
        figures: errors on the recording, as JSON.
        lineage: inputs, seeds and versions.

    Raises:
        NotFound: there is no such assessment.
        Conflict: it is not pending.
    """
    row = pending(session, AssessmentRow, assessment_id)
    row.state = "ready"
    row.figures = figures
    row.lineage = lineage.model_dump(mode="json")
    session.flush()
    return row


def _digest(artifacts: list[Any], name: str) -> str | None:
    return next((str(item["sha256"]) for item in artifacts if item["name"] == name), None)


def _trace(row: TraceRow) -> Trace:
    columns = columns_of(row)
    return Trace.model_validate({**columns.pop("report"), **columns})


def _assessment(row: AssessmentRow) -> Assessment:
    columns = columns_of(row)
    links = {
        "self": f"/v1/assessments/{row.id}",
        "job": f"/v1/jobs/{row.job_id}",
        "model": f"/v1/models/{row.name}/versions/{row.version}",
    }
    if row.trace_id is not None:
        links["trace"] = f"/v1/traces/{row.trace_id}"
    return Assessment.model_validate({**columns.pop("figures"), **columns, "links": links})
