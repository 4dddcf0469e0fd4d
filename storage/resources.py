"""Scenes, fits, datasets and episodes: rows in, wire models out.

A fit, a dataset and a model version are born pending with their job (``physworld_storage.jobs.kinds``) and filled in
by the commit of its last shard (``physworld_storage.jobs.flow``); what is ready or sealed never changes again.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session, defer

from physworld_schemas.base import Artifact, Lineage, Page, Unmade
from physworld_schemas.dataset import Dataset, Episode
from physworld_schemas.fit import Fit, Parameter
from physworld_schemas.ids import new_id
from physworld_schemas.scene import Scene, ScenePatch
from physworld_storage.errors import Conflict, NotFound, ResultInvalid
from physworld_storage.pages import page_of
from physworld_storage.rows import chosen, pending, plain, required
from physworld_storage.search import listing, matching
from physworld_storage.tables import (
    DatasetRow,
    EpisodeRow,
    FitRow,
    SceneRow,
    columns_of,
    insert_if_absent,
    utc_now,
)

_LIFTED = (
    "numerics",
    "converged",
    "not_measured",
    "search",
    "local",
    "notes",
    "scene_ids",
)  # of a fit's metrics: fields of their own


def create_scene(
    session: Session,
    *,
    name: str,
    kind: str,
    digest: str,
    frames: int,
    points: int,
    controllers: int,
    fps: float,
    duration_s: float,
    noise_sigma_m: float | None,
    train: tuple[int, int],
    test: tuple[int, int],
    description: str = "",
    declared: dict[str, Any] | None = None,
    warnings: list[str] | None = None,
    artifacts: list[Artifact] | None = None,
    tags: list[str] | None = None,
) -> Scene:
    """Register a scene whose canonical bundle has ``digest``; the same digest gives back the same scene.

    Args:
        session: the transaction that it belongs to.
        name: for people.
        kind: of the object, as the scene declares it.
        digest: SHA-256 of the canonical bundle.
        frames: T.
        points: N, measured points a frame.
        controllers: K, driven points a frame.
        fps: frames a second [1/s].
        duration_s: from the first frame to the last [s].
        noise_sigma_m: tracking noise, one deviation per axis [m]; None where it is not known.
        train: first frame, and the frame after the last, that may be fitted to.
        test: likewise of the frames that only measure.
        description: for people.
        declared: ``scene.json`` as it was validated.
        warnings: of the validator and of the importer.
        artifacts: the stored files.
        tags: for people, without repetitions.
    """
    values = {
        "id": new_id("scene"),
        "name": name,
        "kind": kind,
        "description": description,
        "created_at": utc_now(),
        "digest": digest,
        "frames": frames,
        "points": points,
        "controllers": controllers,
        "fps": fps,
        "duration_s": duration_s,
        "noise_sigma_m": noise_sigma_m,
        "train": list(train),
        "test": list(test),
        "declared": declared or {},
        "warnings": list(warnings or []),
        "artifacts": plain(artifacts or []),
        "tags": list(tags or []),
    }
    insert_if_absent(session, SceneRow, values)
    row = session.scalars(select(SceneRow).where(SceneRow.digest == digest)).one()
    return _scene(row)


def get_scene(session: Session, scene_id: str) -> Scene:
    """The scene, or NotFound."""
    return _scene(required(session, SceneRow, scene_id))


def find_scene(session: Session, digest: str) -> Scene | None:
    """The scene whose canonical bundle has ``digest``, None when there is none."""
    row = session.scalars(select(SceneRow).where(SceneRow.digest == digest)).one_or_none()
    return None if row is None else _scene(row)


def patch_scene(session: Session, scene_id: str, patch: ScenePatch) -> Scene:
    """Give a scene other tags, each once. Raises NotFound."""
    row = session.get(SceneRow, scene_id, with_for_update=True)
    if row is None:
        raise NotFound("scene", scene_id)
    row.tags = list(dict.fromkeys(patch.tags))
    session.flush()
    return get_scene(session, scene_id)


def list_scenes(
    session: Session,
    *,
    limit: int = 50,
    cursor: str | None = None,
    kind: str | None = None,
    tag: str | None = None,
    search: str | None = None,
) -> Page[Scene]:
    """Scenes, newest first, without their declared documents, which are not read either.

    Args:
        session: the transaction that reads.
        limit: most scenes of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        kind: only objects of this kind.
        tag: only scenes that have this tag, in any case.
        search: words that an id, a name, a kind or a tag holds.

    Raises:
        InvalidCursor: no list of scenes gave this cursor out.
    """
    statement = select(SceneRow).options(defer(SceneRow.declared, raiseload=True))
    statement = matching(statement, search, SceneRow.id, SceneRow.name, SceneRow.kind, SceneRow.tags)
    statement = chosen(statement, (SceneRow.kind, kind))
    if tag is not None:
        statement = statement.where(listing(SceneRow.tags, tag))
    keys = (SceneRow.created_at, SceneRow.id)
    return page_of(session, statement, keys, _listed_scene, limit=limit, cursor=cursor)


def get_fit(session: Session, fit_id: str) -> Fit:
    """The fit, or NotFound."""
    return _fit(required(session, FitRow, fit_id))


def list_fits(
    session: Session,
    *,
    limit: int = 50,
    cursor: str | None = None,
    state: str | None = None,
    scene_id: str | None = None,
    search: str | None = None,
) -> Page[Fit]:
    """Fits, newest first.

    Args:
        session: the transaction that reads.
        limit: most fits of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        state: only fits of this state.
        scene_id: only fits of this scene.
        search: words that an id, a state or the scene's name holds.

    Raises:
        InvalidCursor: no list of fits gave this cursor out.
    """
    statement = matching(select(FitRow), search, FitRow.id, FitRow.state, scene_id=FitRow.scene_id)
    statement = chosen(statement, (FitRow.state, state), (FitRow.scene_id, scene_id))
    return page_of(session, statement, (FitRow.created_at, FitRow.id), _fit, limit=limit, cursor=cursor)


def mark_fit_ready(
    session: Session,
    fit_id: str,
    parameters: dict[str, Parameter],
    metrics: dict[str, Any],
    artifacts: list[Artifact],
    lineage: Lineage,
) -> Fit:
    """Fill in a pending fit.

    Args:
        session: the transaction that commits the shard.
        fit_id: of a pending fit.
        parameters: calibrated numbers by name, with units and intervals.
        metrics: held-out errors and how the search went, as JSON.
        artifacts: twin, prediction and report.
        lineage: inputs, seeds and versions.

    Raises:
        NotFound: there is no such fit.
        Conflict: it is not pending.
    """
    row = pending(session, FitRow, fit_id)
    row.state = "ready"
    row.parameters = {name: parameter.model_dump(mode="json") for name, parameter in parameters.items()}
    row.metrics = {**row.metrics, **metrics}  # which other recordings were asked for stays
    row.artifacts = plain(artifacts)
    row.lineage = lineage.model_dump(mode="json")
    session.flush()
    return _fit(row)


def get_dataset(session: Session, dataset_id: str) -> Dataset:
    """The dataset, or NotFound."""
    return _dataset(required(session, DatasetRow, dataset_id))


def list_datasets(
    session: Session,
    *,
    limit: int = 50,
    cursor: str | None = None,
    state: str | None = None,
    fit_id: str | None = None,
    scene_id: str | None = None,
    search: str | None = None,
) -> Page[Dataset]:
    """Datasets, newest first.

    Args:
        session: the transaction that reads.
        limit: most datasets of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        state: only datasets of this state.
        fit_id: only demonstrations of this fit's twin.
        scene_id: only those of this scene.
        search: words that an id, a state or the scene's name holds.

    Raises:
        InvalidCursor: no list of datasets gave this cursor out.
    """
    columns = (DatasetRow.id, DatasetRow.state)
    statement = matching(select(DatasetRow), search, *columns, scene_id=DatasetRow.scene_id)
    filters = ((DatasetRow.state, state), (DatasetRow.fit_id, fit_id), (DatasetRow.scene_id, scene_id))
    statement = chosen(statement, *filters)
    keys = (DatasetRow.created_at, DatasetRow.id)
    return page_of(session, statement, keys, _dataset, limit=limit, cursor=cursor)


def start_writing(session: Session, dataset_id: str) -> None:
    """The dataset is planned; episodes follow."""
    row = required(session, DatasetRow, dataset_id)
    if row.state != "pending":
        raise Conflict(f"dataset {dataset_id} is {row.state}; only a pending dataset can be planned")
    row.state = "writing"


def add_episode(
    session: Session, dataset_id: str, shard_id: str, episode: Episode, seconds: float | None = None
) -> None:
    """Commit one episode. The primary key (dataset, index) makes a second one impossible.

    Args:
        session: the transaction that commits the shard.
        dataset_id: of a dataset that is being written.
        shard_id: which wrote it.
        episode: its index, path, digest and outcome.
        seconds: that it took [s], where known.

    Raises:
        NotFound: there is no such dataset.
        Conflict: the dataset is sealed or has failed.
    """
    row = required(session, DatasetRow, dataset_id)
    if row.state != "writing":
        raise Conflict(f"dataset {dataset_id} is {row.state}; episodes are added while it is being written")
    values = episode.model_dump()
    session.add(
        EpisodeRow(dataset_id=dataset_id, shard_id=shard_id, seconds=seconds, created_at=utc_now(), **values)
    )
    row.episodes_done += 1
    session.flush()


def get_episode(session: Session, dataset_id: str, index: int) -> Episode:
    """One committed episode, or NotFound."""
    row = session.get(EpisodeRow, (dataset_id, index))
    if row is None:
        raise NotFound("episode", f"{dataset_id}/{index}")
    return _episode(row)


def list_episodes(
    session: Session, dataset_id: str, *, limit: int = 50, cursor: str | None = None
) -> Page[Episode]:
    """Committed episodes of a dataset, by index.

    Args:
        session: the transaction that reads.
        dataset_id: whose episodes.
        limit: most episodes of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the first.

    Raises:
        NotFound: there is no such dataset.
        InvalidCursor: no list of episodes gave this cursor out.
    """
    required(session, DatasetRow, dataset_id)
    statement = select(EpisodeRow).where(EpisodeRow.dataset_id == dataset_id)
    return page_of(
        session, statement, (EpisodeRow.index,), _episode, limit=limit, cursor=cursor, ascending=True
    )


def all_episodes(session: Session, dataset_id: str) -> list[Episode]:
    """Every committed episode of a dataset, by index: what the seal writes into the manifest."""
    required(session, DatasetRow, dataset_id)
    statement = select(EpisodeRow).where(EpisodeRow.dataset_id == dataset_id).order_by(EpisodeRow.index)
    return [_episode(row) for row in session.scalars(statement)]


def seal_dataset(
    session: Session,
    dataset_id: str,
    *,
    digest: str,
    statistics: dict[str, Any],
    artifacts: list[Artifact],
    lineage: Lineage,
) -> Dataset:
    """Close a dataset under the digest of its manifest.

    Args:
        session: the transaction that commits the last shard.
        dataset_id: of a dataset that is being written.
        digest: SHA-256 of its manifest.
        statistics: of its episodes, as JSON.
        artifacts: manifest, card and pictures.
        lineage: inputs, seeds and versions.

    Raises:
        NotFound: there is no such dataset.
        Conflict: it is not being written.
        ResultInvalid: fewer or more episodes were committed than were counted.
    """
    row = required(session, DatasetRow, dataset_id)
    if row.state != "writing":
        raise Conflict(f"dataset {dataset_id} is {row.state}; only one that is being written is sealed")
    statement = select(func.count()).select_from(EpisodeRow).where(EpisodeRow.dataset_id == dataset_id)
    committed = session.scalar(statement)
    if committed != row.episodes_done:
        counts = f"{committed} episodes, {row.episodes_done} were counted"
        raise ResultInvalid(f"dataset {dataset_id} holds {counts}")
    row.state = "sealed"
    row.digest = digest
    row.statistics = statistics
    row.artifacts = plain(artifacts)
    row.lineage = lineage.model_dump(mode="json")
    session.flush()
    return _dataset(row)


def end_dataset(session: Session, dataset_id: str, state: Unmade) -> None:
    """Mark a dataset failed or cancelled unless it is sealed."""
    row = required(session, DatasetRow, dataset_id)
    if row.state != "sealed":
        row.state = state


def _scene(row: SceneRow) -> Scene:
    return Scene.model_validate(columns_of(row))


def _listed_scene(row: SceneRow) -> Scene:
    return Scene.model_validate(columns_of(row, without="declared"))


def _fit(row: FitRow) -> Fit:
    values = columns_of(row)
    metrics = dict(values["metrics"])
    lifted = {name: metrics.pop(name) for name in _LIFTED if name in metrics}
    return Fit.model_validate({**values, "metrics": metrics, **lifted})


def _dataset(row: DatasetRow) -> Dataset:
    return Dataset.model_validate(columns_of(row))


def _episode(row: EpisodeRow) -> Episode:
    return Episode.model_validate(columns_of(row))
