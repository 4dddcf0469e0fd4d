"""Loops as the wire shows them: read from the job and from what its children have made, which hold everything."""

from __future__ import annotations

from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.assessment import Assessment
from physworld_schemas.base import Page
from physworld_schemas.loop import Loop, LoopOutcome, VersionError
from physworld_schemas.trace import Trace
from physworld_storage.errors import NotFound
from physworld_storage.jobs.kind import output_of
from physworld_storage.jobs.kinds import loop
from physworld_storage.pages import page_of
from physworld_storage.rows import required
from physworld_storage.tables import AssessmentRow, JobRow, ModelVersionRow, TraceRow
from physworld_storage.traces import get_assessment, get_trace, leaves_twin


def get_loop(session: Session, loop_id: str) -> Loop:
    """The loop, or NotFound."""
    row = session.get(JobRow, loop_id)
    if row is None or row.kind != loop.KIND.name:
        raise NotFound("loop", loop_id)
    return _loop(session, row)


def list_loops(
    session: Session,
    *,
    limit: int = 50,
    cursor: str | None = None,
    state: str | None = None,
    model: str | None = None,
) -> Page[Loop]:
    """Loops, newest first.

    Args:
        session: the transaction that reads.
        limit: most loops of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        state: only loops of this state.
        model: only loops of this model.

    Raises:
        InvalidCursor: no list of loops gave this cursor out.
    """
    statement = select(JobRow).where(JobRow.kind == loop.KIND.name)
    if state is not None:
        statement = statement.where(JobRow.state == state)
    if model is not None:
        statement = statement.where(JobRow.config["model"].as_string() == model)
    keys = (JobRow.created_at, JobRow.id)
    return page_of(session, statement, keys, lambda row: _loop(session, row), limit=limit, cursor=cursor)


def _loop(session: Session, row: JobRow) -> Loop:
    request = loop.request_of(row)
    made: dict[str, str] = {}
    for child in session.scalars(select(JobRow).where(JobRow.parent_id == row.id)):
        made["comparison" if _is_comparison(child) else child.kind] = output_of(child)
    begun = row.config["assessment_id"] or made.get(loop.ASSESSMENT)
    trace_id = made.get(loop.TRACE)
    traced = _trace(session, trace_id)
    compared = _assessment(session, made.get("comparison"))
    number = made[loop.TRAINING].rpartition(":")[2] if loop.TRAINING in made else None
    outcome = _outcome(row, made, compared)
    fields: dict[str, Any] = {
        "id": row.id,
        "model": request.model,
        "version": request.version,
        "scene_id": request.scene_id,
        "state": row.state,
        "created_at": row.created_at,
        "finished_at": row.finished_at,
        "progress": row.progress,
        "outcome": outcome,
        "assessment_id": begun,
        "trace_id": trace_id,
        "verdict": None if traced is None else traced.verdict,
        "effects": [] if traced is None or loop.DATASET not in made else traced.effects,
        "dataset_id": made.get(loop.DATASET),
        "new_version": number,
        "comparison_id": made.get("comparison"),
        "error": row.error,
        "links": _links(row, begun, made, number),
        **_errors(compared),
    }
    found = Loop.model_validate(fields)
    if outcome == "as_expected":
        first = _assessment(session, begun)
        found.reason = "" if first is None else first.reason
    elif outcome == "no_effect" and traced is not None:
        found.reason = f"The trace supports no effect ({traced.verdict}): {traced.reason}"
    else:
        found.reason = _gain(found, _effects_of(session, found.model, found.version))
    return found


def _is_comparison(child: JobRow) -> bool:
    return child.kind == loop.ASSESSMENT and loop.is_comparison(child)


def _assessment(session: Session, assessment_id: str | None) -> Assessment | None:
    """The assessment; None where there is none, or where somebody has deleted it."""
    if assessment_id is None or session.get(AssessmentRow, assessment_id) is None:
        return None
    return get_assessment(session, assessment_id)


def _trace(session: Session, trace_id: str | None) -> Trace | None:
    """The trace; None where there is none, or where somebody has deleted it."""
    if trace_id is None or session.get(TraceRow, trace_id) is None:
        return None
    return get_trace(session, trace_id)


def _outcome(row: JobRow, made: dict[str, str], compared: Assessment | None) -> LoopOutcome | None:
    if row.state != "succeeded":
        return None
    if loop.TRACE not in made:
        return "as_expected"
    if loop.TRAINING not in made:
        return "no_effect"
    if compared is None or compared.compared is None:
        return None
    return "improved" if compared.compared.gain_ci95_m[0] > 0 else "not_improved"


def _errors(compared: Assessment | None) -> dict[str, Any]:
    """Errors of both versions on the held-out frames; empty before they are measured."""
    if compared is None or compared.measured is None or compared.compared is None:
        return {}
    old = compared.compared
    return {
        "before": VersionError(version=old.version, measured=old.measured, twin_m=old.twin_m),
        "after": VersionError(version=compared.version, measured=compared.measured, twin_m=compared.twin_m),
        "gain_m": old.gain_m,
        "gain_ci95_m": old.gain_ci95_m,
        "baselines_m": compared.baselines_m,
    }


def _effects_of(session: Session, model: str, version: int) -> set[str]:
    """Names of the effects that a version's twin carries already."""
    row = session.get(ModelVersionRow, (model, version))
    if row is None or row.trace_id is None:
        return set()
    traced = required(session, TraceRow, row.trace_id)
    return {effect["name"] for effect in traced.report.get("effects", ())} if leaves_twin(traced) else set()


def _gain(found: Loop, carried: set[str]) -> str:
    """Both errors in a sentence, and whether the effects are no other than those carried; empty without errors."""
    if found.before is None or found.after is None or found.gain_ci95_m is None:
        return ""
    low, high = (1e3 * end for end in found.gain_ci95_m)
    known = carried == {effect.name for effect in found.effects}
    anew = f"; the effects are those of version {found.before.version}, estimated anew" if known else ""
    return (
        f"On held-out frames of the new recording version {found.after.version} errs "
        f"{1e3 * found.after.measured.error_m:.3g} mm, version {found.before.version} "
        f"{1e3 * found.before.measured.error_m:.3g} mm (gain 95 % {low:.3g} to {high:.3g} mm){anew}"
    )


def _links(row: JobRow, begun: str | None, made: dict[str, str], number: str | None) -> dict[str, str]:
    model = f"/v1/models/{row.config['model']}/versions"
    links = {
        "self": f"/v1/loops/{row.id}",
        "job": f"/v1/jobs/{row.id}",
        "model": f"{model}/{row.config['version']}",
        "scene": f"/v1/scenes/{row.config['scene_id']}",
    }
    given = {"assessment": begun, "trace": made.get(loop.TRACE), "dataset": made.get(loop.DATASET)}
    links |= {kind: f"/v1/{kind}s/{known}" for kind, known in given.items() if known is not None}
    if number is not None:
        links["new_version"] = f"{model}/{number}"
    if "comparison" in made:
        links["comparison"] = f"/v1/assessments/{made['comparison']}"
    return links
