"""What belongs to a scene, as a graph: its fits, traces, datasets, model versions, and what these were used for.

Only what a picture shows is read: identifiers, states, and who was made from whom.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, and_, or_, select
from sqlalchemy.orm import Session

from physworld_schemas.quality import quality_of
from physworld_schemas.standing import standing_of
from physworld_storage.tables import (
    AssessmentRow,
    DatasetRow,
    FitRow,
    ModelVersionRow,
    RunRow,
    SceneRow,
    TraceRow,
)

MOST = 500
"""Newest objects of a kind that are looked at."""
KINDS = ("scene", "fit", "trace", "dataset", "model", "use")
"""Columns of the picture: each is made from those before it."""


@dataclass(frozen=True)
class Member:
    """One object of the family.

    Attributes:
        key: the object's id, of a version ``name:version``.
        kind: of the object.
        column: its place among ``KINDS``.
        label: for people.
        state: of the object, as lists call it (``schemas/standing.py``); empty for a scene.
        parents: keys of what it was made from.
    """

    key: str
    kind: str
    column: int
    label: str
    state: str
    parents: tuple[str, ...]


def family_of(session: Session, scene_id: str) -> list[Member]:
    """Everything that was made of a scene, column by column, the newest first."""
    name = session.scalar(select(SceneRow.name).where(SceneRow.id == scene_id))
    if name is None:
        return []
    found = [Member(scene_id, "scene", 0, name, "", ())]
    fits = select(FitRow.id, FitRow.state, FitRow.metrics["search"]).where(FitRow.scene_id == scene_id)
    for key, state, search in _newest(session, fits, FitRow):
        standing = standing_of(state, converged=(search or {}).get("converged"))
        found.append(Member(key, "fit", 1, _short(key), standing, (scene_id,)))
    asked = select(TraceRow.id, TraceRow.state, TraceRow.verdict, TraceRow.fit_id).where(
        TraceRow.scene_id == scene_id
    )
    own = {member.key for member in found}  # a trace may begin with a fit of another recording
    for key, state, verdict, fit in _newest(session, asked, TraceRow):
        label = verdict.replace("_", " ") if verdict else _short(key)
        found.append(Member(key, "trace", 2, label, state, (fit if fit in own else scene_id,)))
    columns = DatasetRow.id, DatasetRow.state, DatasetRow.fit_id, DatasetRow.trace_id
    made = select(*columns).where(DatasetRow.scene_id == scene_id)
    for key, state, fit, trace in _newest(session, made, DatasetRow):
        found.append(Member(key, "dataset", 3, _short(key), state, tuple(filter(None, (fit, trace)))))
    version = ModelVersionRow
    judged = version.metrics["held_out"], version.metrics["energy"]
    trained = select(version.name, version.version, version.state, version.dataset_id, *judged).where(
        version.scene_id == scene_id
    )
    versions = _newest(session, trained, version)
    for model, number, state, dataset, held_out, energy in versions:
        parents = (dataset,) if dataset else (scene_id,)
        standing = standing_of(state, verdict=quality_of({"held_out": held_out, "energy": energy}).verdict)
        found.append(Member(f"{model}:{number}", "model", 4, f"{model} {number}", standing, parents))
    return found + _uses(session, [(one.name, one.version) for one in versions])


def related(members: Sequence[Member], focus: str) -> list[Member]:
    """What the focus was made from, however far back, and what was made from it."""
    by_key = {member.key: member for member in members}
    if focus not in by_key:
        return list(members)
    children: dict[str, list[str]] = {}
    for member in members:
        for parent in member.parents:
            children.setdefault(parent, []).append(member.key)
    kept = _reached(focus, lambda key: by_key[key].parents if key in by_key else ())
    kept |= _reached(focus, lambda key: children.get(key, ()))
    return [member for member in members if member.key in kept]


def ancestors(members: Sequence[Member], focus: str) -> set[str]:
    """The focus and what it was made from."""
    by_key = {member.key: member for member in members}
    return _reached(focus, lambda key: by_key[key].parents if key in by_key else ())


def _uses(session: Session, versions: Sequence[tuple[str, int]]) -> list[Member]:
    """Rollouts, plans and assessments of versions."""
    if not versions:
        return []
    run, held = RunRow, AssessmentRow
    of_runs = or_(*(and_(run.model == name, run.version == number) for name, number in versions[:100]))
    of_held = or_(*(and_(held.name == name, held.version == number) for name, number in versions[:100]))
    runs = _newest(session, select(run.id, run.kind, run.state, run.model, run.version).where(of_runs), run)
    held_out = _newest(session, select(held.id, held.state, held.name, held.version).where(of_held), held)
    found = [Member(i, k, 5, f"{k} {_short(i)}", s, (f"{m}:{v}",)) for i, k, s, m, v in runs]
    return found + [
        Member(i, "assessment", 5, f"assessment {_short(i)}", s, (f"{m}:{v}",)) for i, s, m, v in held_out
    ]


def _newest(session: Session, statement: Select[*tuple[Any, ...]], row: Any) -> list[Any]:
    return list(session.execute(statement.order_by(row.created_at.desc()).limit(MOST)))


def _reached(start: str, following: Any) -> set[str]:
    met, waiting = {start}, [start]
    while waiting:
        nexts: Iterable[str] = following(waiting.pop())
        fresh = [key for key in nexts if key not in met]
        met.update(fresh)
        waiting += fresh
    return met


def _short(key: str) -> str:
    return f"…{key[-6:]}"
