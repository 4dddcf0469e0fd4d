"""The model registry: a name, integer versions that only grow, aliases that move.

A version's number is allotted in the transaction that opens its training job and never given twice, also
when the training fails. Ready versions are immutable.
"""

from __future__ import annotations

import re
from contextlib import closing
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.base import Artifact, Lineage, Page, Unmade
from physworld_schemas.model import Model, ModelVersion, TrainingConfig, VersionPatch
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.pages import page_of
from physworld_storage.rows import chosen
from physworld_storage.search import matching
from physworld_storage.tables import (
    AliasRow,
    DatasetRow,
    FitRow,
    ModelRow,
    ModelVersionRow,
    TraceRow,
    columns_of,
    insert_if_absent,
    utc_now,
)
from physworld_storage.traces import fit_digest, leaves_twin

LATEST = "latest"
MOST_DIGITS = 9  # of a version's number: the column holds no more
ALIAS_PATTERN = re.compile(r"[a-z][a-z0-9_-]{0,31}")


def reference_id(name: str, version: int) -> str:
    """The id by which lineage and job outputs name a version: ``beam:3``."""
    return f"{name}:{version}"


def allot_version(
    session: Session,
    name: str,
    *,
    config: TrainingConfig,
    job_id: str | None = None,
    scene_id: str | None = None,
    fit_id: str | None = None,
    trace_id: str | None = None,
    dataset_id: str | None = None,
    description: str = "",
    tags: list[str] | None = None,
) -> ModelVersionRow:
    """The next version of ``name``, pending. The first one registers the name.

    Args:
        session: the transaction that it belongs to.
        name: of the model.
        config: of the training that will fill it.
        job_id: of that training.
        scene_id: the recording that it comes from.
        fit_id: whose twin demonstrates.
        trace_id: whose effects the twin carries, if any.
        dataset_id: what it learns from.
        description: for people; it may change later.
        tags: likewise.
    """
    model = _lock_model(session, name)
    model.last_version += 1
    row = ModelVersionRow(
        name=name,
        version=model.last_version,
        state="pending",
        message="",
        created_at=utc_now(),
        job_id=job_id,
        scene_id=scene_id,
        fit_id=fit_id,
        trace_id=trace_id,
        dataset_id=dataset_id,
        description=description,
        tags=list(tags or []),
        config=config.model_dump(mode="json"),
        metrics={},
        lineage=Lineage(job_id=job_id).model_dump(mode="json"),
        artifacts=[],
    )
    session.add(row)
    session.flush()
    return row


def publish(
    session: Session,
    name: str,
    version: int,
    *,
    artifacts: list[Artifact],
    sha256: str,
    metrics: dict[str, Any],
    lineage: Lineage,
) -> ModelVersion:
    """Make a pending version ready.

    Args:
        session: the transaction that commits the training.
        name: of the model.
        version: its number.
        artifacts: its files, the signature among them.
        sha256: of the signed manifest.
        metrics: held-out errors, speeds and what the card tells, as JSON.
        lineage: inputs, seeds and versions.

    Raises:
        NotFound: there is no such version.
        Conflict: it is not pending: versions are immutable.
    """
    row = version_row(session, name, version)
    if row.state != "pending":
        raise Conflict(f"version {version} of {name} is {row.state}; only a pending version is published")
    row.state = "ready"
    row.artifacts = [artifact.model_dump(mode="json") for artifact in artifacts]
    row.sha256 = sha256
    row.metrics = metrics
    row.lineage = lineage.model_dump(mode="json")
    session.flush()
    return _version(row, [])


def end_version(session: Session, name: str, version: int, state: Unmade, message: str) -> None:
    """Mark a pending version failed or cancelled; a ready one stays as it is.

    Args:
        session: the transaction that it belongs to.
        name: of the model.
        version: its number.
        state: what it is from now on.
        message: why it failed, for people.
    """
    row = version_row(session, name, version)
    if row.state == "pending":
        row.state = state
        row.message = message


def patch_version(session: Session, name: str, version: int | str, patch: VersionPatch) -> ModelVersion:
    """Change description and tags, which are no part of the signed files; what is None stays.

    Args:
        session: the transaction that it belongs to.
        name: of the model.
        version: its number, or an alias.
        patch: what to change.

    Raises:
        NotFound: there is no such version or alias.
    """
    row = version_row(session, name, resolve(session, name, version))
    if patch.description is not None:
        row.description = patch.description
    if patch.tags is not None:
        row.tags = list(dict.fromkeys(patch.tags))
    session.flush()
    return _version(row, _aliases_of(session, name, row.version))


def get_model(session: Session, name: str) -> Model:
    """The model called ``name``."""
    return _model(session, _model_row(session, name))


def list_models(
    session: Session, *, limit: int = 50, cursor: str | None = None, search: str | None = None
) -> Page[Model]:
    """Models, newest first.

    Args:
        session: the transaction that reads.
        limit: most models of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        search: words that a name holds.

    Raises:
        InvalidCursor: no list of models gave this cursor out.
    """
    statement = matching(select(ModelRow), search, ModelRow.name)
    keys = (ModelRow.created_at, ModelRow.name)
    return page_of(session, statement, keys, lambda row: _model(session, row), limit=limit, cursor=cursor)


def get_version(session: Session, name: str, version: int | str) -> ModelVersion:
    """A version by number, alias or ``latest``: the newest that is ready and did not fail the quality gate."""
    row = version_row(session, name, resolve(session, name, version))
    return _version(row, _aliases_of(session, name, row.version))


def list_versions(
    session: Session,
    name: str,
    *,
    limit: int = 50,
    cursor: str | None = None,
    state: str | None = None,
    search: str | None = None,
) -> Page[ModelVersion]:
    """Versions of a model, newest first; a search looks at their descriptions, tags and states.

    Args:
        session: the transaction that reads.
        name: of the model.
        limit: most versions of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        state: only versions of this state.
        search: words that a description, a tag, a message or a state holds.

    Raises:
        NotFound: there is no such model.
        InvalidCursor: no list of versions gave this cursor out.
    """
    _model_row(session, name)
    statement = select(ModelVersionRow).where(ModelVersionRow.name == name)
    columns = (
        ModelVersionRow.description,
        ModelVersionRow.message,
        ModelVersionRow.tags,
        ModelVersionRow.state,
    )
    statement = matching(statement, search, *columns)
    statement = chosen(statement, (ModelVersionRow.state, state))
    return page_of(
        session,
        statement,
        (ModelVersionRow.version,),
        lambda row: _version(row, _aliases_of(session, name, row.version)),
        limit=limit,
        cursor=cursor,
    )


def resolve(session: Session, name: str, version: int | str) -> int:
    """The number behind a number, an alias or ``latest``.

    Raises NotFound, or Conflict where there are ready versions and all of them failed the quality gate.
    """
    if isinstance(version, int):
        return version
    if version.isdecimal():
        if len(version) > MOST_DIGITS:
            raise NotFound("model version", f"{name}:{version[:MOST_DIGITS]}…")
        return int(version)
    _model_row(session, name)
    if version == LATEST:
        newest, refused = _latest(session, name)
        if newest is None and refused is None:
            raise NotFound("ready version of model", name)
        if newest is None:
            assert refused is not None
            raise Conflict(
                f"no version of {name} passed the quality gate, so none is {LATEST}; version {refused.version}, the "
                f"newest that is ready, can be had by its number: {'; '.join(refused.quality.reasons)}"
            )
        return newest
    alias = session.get(AliasRow, (name, version))
    if alias is None:
        raise NotFound("alias", f"{name}@{version}")
    return alias.version


def baseline_of(
    session: Session, name: str, dataset: DatasetRow, config: TrainingConfig
) -> ModelVersionRow | None:
    """What a version of ``name`` on ``dataset`` is to be compared with, None where there is nothing.

    See ``find_baseline``; a dataset whose twin carries no effects has none.

    Args:
        session: the transaction that reads.
        name: of the model.
        dataset: what the version learns from.
        config: of its training.
    """
    trace = session.get(TraceRow, dataset.trace_id) if dataset.trace_id else None
    if trace is None or not leaves_twin(trace):
        return None
    return find_baseline(session, name, dataset.fit_id, dataset.config, config)


def find_baseline(
    session: Session, name: str, fit_id: str, dataset_config: dict[str, Any], config: TrainingConfig
) -> ModelVersionRow | None:
    """The newest ready version of ``name`` that learned from the fit's own twin with these settings.

    The fit may be another one, if its twin is equal to the last bit.

    Args:
        session: the transaction that reads.
        name: of the model.
        fit_id: whose twin, without effects, demonstrated.
        dataset_config: settings of the demonstrations, as JSON; equal ones are asked for.
        config: of the training; equal ones are asked for.
    """
    fit = session.get_one(FitRow, fit_id)
    statement = (
        select(ModelVersionRow, DatasetRow, FitRow)
        .join(DatasetRow, DatasetRow.id == ModelVersionRow.dataset_id)
        .join(FitRow, FitRow.id == ModelVersionRow.fit_id)
        .where(
            ModelVersionRow.name == name,
            ModelVersionRow.state == "ready",
            ModelVersionRow.scene_id == fit.scene_id,
            ModelVersionRow.trace_id.is_(None),
        )
        .order_by(ModelVersionRow.version.desc())
    )
    wanted = (config, dataset_config, fit_digest(fit))
    for version, dataset, other in session.execute(statement):
        if (trained_with(version), dataset.config, fit_digest(other)) == wanted:
            return version
    return None


def trained_with(version: ModelVersionRow) -> TrainingConfig:
    """The settings of a version's training; those from before the setting ``frame`` took the world's axes."""
    return TrainingConfig.model_validate({"frame": "world", **version.config})


def set_alias(session: Session, name: str, alias: str, version: int) -> Model:
    """Point ``alias`` at a ready version; it moves when it exists already.

    Args:
        session: the transaction that it belongs to.
        name: of the model.
        alias: as ``ALIAS_PATTERN`` has it, and not ``latest``.
        version: number of a ready version.

    Raises:
        NotFound: there is no such version.
        Conflict: the alias is reserved or misspelt, or the version is not ready.
    """
    if alias == LATEST or not ALIAS_PATTERN.fullmatch(alias):
        raise Conflict(f"{alias!r} cannot be an alias: it is reserved or not [a-z][a-z0-9_-]{{0,31}}")
    row = version_row(session, name, version)
    if row.state != "ready":
        raise Conflict(f"version {version} of {name} is {row.state}; an alias needs a ready version")
    _lock_model(session, name)
    present = session.get(AliasRow, (name, alias))
    if present is None:
        session.add(AliasRow(name=name, alias=alias, version=version, updated_at=utc_now()))
    else:
        present.version = version
        present.updated_at = utc_now()
    session.flush()
    return get_model(session, name)


def delete_alias(session: Session, name: str, alias: str) -> Model:
    """Remove an alias; the version stays. Raises NotFound."""
    present = session.get(AliasRow, (name, alias))
    if present is None:
        raise NotFound("alias", f"{name}@{alias}")
    session.delete(present)
    session.flush()
    return get_model(session, name)


def _lock_model(session: Session, name: str) -> ModelRow:
    """The row of ``name``, made if absent, locked against other allotments until the transaction ends."""
    if session.get(ModelRow, name) is None:
        insert_if_absent(session, ModelRow, {"name": name, "created_at": utc_now(), "last_version": 0})
    statement = select(ModelRow).where(ModelRow.name == name).with_for_update()
    return session.scalars(statement.execution_options(populate_existing=True)).one()


def _model_row(session: Session, name: str) -> ModelRow:
    row = session.get(ModelRow, name)
    if row is None:
        raise NotFound("model", name)
    return row


def version_row(session: Session, name: str, version: int) -> ModelVersionRow:
    """The row, or NotFound."""
    row = session.get(ModelVersionRow, (name, version))
    if row is None:
        raise NotFound("model version", reference_id(name, version))
    return row


def _latest(session: Session, name: str) -> tuple[int | None, ModelVersion | None]:
    """What ``latest`` stands for, None without one; and the newest ready version that failed the gate on the way."""
    statement = (
        select(ModelVersionRow)
        .where(ModelVersionRow.name == name, ModelVersionRow.state == "ready")
        .order_by(ModelVersionRow.version.desc())
    )
    refused: ModelVersion | None = None
    with closing(session.scalars(statement.execution_options(yield_per=1))) as rows:
        for row in rows:
            version = _version(row, [])
            if version.quality.verdict != "failed":
                return row.version, refused
            refused = refused or version
    return None, refused


def _aliases_of(session: Session, name: str, version: int) -> list[str]:
    statement = select(AliasRow.alias).where(AliasRow.name == name, AliasRow.version == version)
    return list(session.scalars(statement.order_by(AliasRow.alias)))


def _model(session: Session, row: ModelRow) -> Model:
    aliases = session.scalars(select(AliasRow).where(AliasRow.name == row.name).order_by(AliasRow.alias))
    return Model(
        name=row.name,
        created_at=row.created_at,
        latest_version=row.last_version or None,
        latest=_latest(session, row.name)[0],
        aliases={alias.alias: alias.version for alias in aliases},
    )


def _version(row: ModelVersionRow, aliases: list[str]) -> ModelVersion:
    return ModelVersion.model_validate({**columns_of(row), "aliases": aliases})
