"""What the faults cost: what the database and the store hold in the end, against what was promised.

Nothing is believed that can be looked at: episodes are read and their digests compared, models' files are read, and
every file of the store is held against the rows that name it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import obstore
from sqlalchemy import func, select

from benchmarks.service.chaos.work import Asked
from physworld_schemas.dataset import Episode
from physworld_storage import resources
from physworld_storage.artifacts import ArtifactStore
from physworld_storage.database import Database, open_database
from physworld_storage.episodes import EpisodeStore
from physworld_storage.errors import StorageError
from physworld_storage.settings import Settings
from physworld_storage.store import open_store
from physworld_storage.tables import (
    AssessmentRow,
    DatasetRow,
    EpisodeRow,
    FitRow,
    JobRow,
    ModelVersionRow,
    RunRow,
    SceneRow,
    ShardRow,
    TraceRow,
)

HOLDERS = (SceneRow, FitRow, TraceRow, DatasetRow, ModelVersionRow, RunRow)
ENDED = frozenset({"succeeded", "failed", "cancelled"})


def count(settings: Settings, asked: Sequence[Asked], episodes: int) -> dict[str, Any]:
    """The ledger of ``asked`` pipelines with so many ``episodes`` each."""
    database = open_database(settings)
    try:
        return {
            **_count_jobs(database, asked),
            **_count_episodes(database, settings, episodes),
            **_count_models(database, settings),
            **_count_orphans(database, settings),
        }
    finally:
        database.dispose()


def faults_of(ledger: dict[str, Any]) -> dict[str, int]:
    """The counts that must be zero, those of them that are not."""
    names = (
        "episodes_lost", "episodes_doubled", "episodes_corrupt", "jobs_lost", "pipelines_lost", "pipelines_doubled",
        "models_missing", "models_doubled", "models_corrupt", "files_missing",
    )  # fmt: skip
    return {name: ledger[name] for name in names if ledger[name]}


def _count_jobs(database: Database, asked: Sequence[Asked]) -> dict[str, Any]:
    """Jobs that ended otherwise than well, or not at all; pipelines that were promised and are not there."""
    with database.reading() as session:
        rows = session.execute(
            select(JobRow.id, JobRow.kind, JobRow.state, JobRow.error, JobRow.config)
        ).all()
        attempts = session.execute(select(ShardRow.kind, ShardRow.attempt)).all()
    lost = [row for row in rows if row.state != "succeeded"]
    known = {row.id for row in rows}
    names = Counter(str(row.config.get("model_name")) for row in rows if row.kind == "pipeline")
    promised = [each for each in asked if each.job_id is not None]
    reasons = Counter(
        str((row.error or {}).get("code", "unknown")) if row.state in ENDED else f"still {row.state}"
        for row in lost
    )
    return {
        "pipelines": sum(names.values()),
        "pipelines_asked": len(asked),
        "pipelines_lost": sum(each.job_id not in known for each in promised),
        "pipelines_doubled": sum(found - 1 for found in names.values()),
        "jobs": len(rows),
        "jobs_lost": len(lost),
        "pipelines_retried": sum(each.retried > 0 for each in asked),
        "lost_because": dict(reasons),
        "lost_details": [
            f"{row.kind} {row.id}: {row.state}: {(row.error or {}).get('detail', '')}"[:400] for row in lost
        ][:20],
        "shards": len(attempts),
        "most_attempts": max((row.attempt for row in attempts), default=0),
        "shards_tried_again": sum(row.attempt > 1 for row in attempts),
    }


def _count_episodes(database: Database, settings: Settings, episodes: int) -> dict[str, Any]:
    """Episodes by pipeline and index: missing, there twice, or not what was committed."""
    store = EpisodeStore(settings)
    with database.reading() as session:
        parent_of = dict(session.execute(select(JobRow.id, JobRow.parent_id)).tuples().all())
        pipelines = session.scalars(select(JobRow.id).where(JobRow.kind == "pipeline")).all()
        datasets = session.execute(select(DatasetRow.id, DatasetRow.job_id, DatasetRow.digest)).all()
        found = {row.id: resources.all_episodes(session, row.id) for row in datasets}
    times: Counter[tuple[str | None, int]] = Counter()
    doubled = corrupt = 0
    for row in datasets:
        times.update((parent_of[row.job_id], episode.index) for episode in found[row.id])
        doubled += len(found[row.id]) - len({episode.digest for episode in found[row.id]})
        corrupt += sum(not _intact(store, episode) for episode in found[row.id])
        if row.digest is not None:
            corrupt += not _is_manifest(store, row.digest, found[row.id])
    expected = {(pipeline, index) for pipeline in pipelines for index in range(episodes)}
    return {
        "episodes_expected": len(expected),
        "episodes_lost": len(expected - times.keys()),
        "episodes_doubled": doubled + sum(number - 1 for number in times.values()),
        "episodes_corrupt": corrupt,
    }


def _intact(store: EpisodeStore, episode: Episode) -> bool:
    try:
        store.verify(episode.path, episode.digest)
    except StorageError:
        return False
    return True


def _is_manifest(store: EpisodeStore, digest: str, episodes: Iterable[Episode]) -> bool:
    """Whether the manifest of a sealed dataset is there and lists just these episodes."""
    try:
        lines = store.read_manifest(digest).episodes
    except StorageError:
        return False
    return [(line.path, line.digest) for line in lines] == [(each.path, each.digest) for each in episodes]


def _count_models(database: Database, settings: Settings) -> dict[str, Any]:
    """Versions that are ready, and files of theirs that are not what their digests say."""
    store = ArtifactStore(settings)
    with database.reading() as session:
        rows = session.execute(
            select(ModelVersionRow.name, ModelVersionRow.state, ModelVersionRow.artifacts)
        ).all()
        wanted = session.scalar(select(func.count()).where(JobRow.kind == "pipeline"))
    ready = [row for row in rows if row.state == "ready"]
    corrupt = 0
    for artifact in (artifact for row in ready for artifact in row.artifacts):
        try:
            store.read_bytes(artifact["sha256"])
        except StorageError:
            corrupt += 1
    return {
        "models_published": len(ready),
        "models_missing": int(wanted or 0) - len({row.name for row in ready}),
        "models_doubled": len(ready) - len({row.name for row in ready}),
        "models_corrupt": corrupt,
    }


def _count_orphans(database: Database, settings: Settings) -> dict[str, Any]:
    """Files that rows name and the store lacks; files that no row names, by their folder; and writes cut short."""
    with database.reading() as session:
        held = {
            artifact["sha256"]
            for holder in HOLDERS
            for artifacts in session.scalars(select(holder.artifacts))
            for artifact in artifacts
        }
        named = held | {digest for digest in session.scalars(select(DatasetRow.digest)) if digest}
        named |= {digest for digest in session.scalars(select(ModelVersionRow.sha256)) if digest}
        named |= _digests_in(session.scalars(select(ShardRow.result)))
        named |= _digests_in(session.scalars(select(AssessmentRow.figures)))
        paths = set(session.scalars(select(EpisodeRow.path)))
    kinds: Counter[str] = Counter()
    present = set()
    for batch in obstore.list(open_store(settings)):
        for entry in batch:
            path = str(entry["path"])
            present.add(path.rpartition("/")[2])
            if path.rpartition("/")[2] not in named and path not in paths:
                kinds[path.partition("/")[0]] += 1
    if settings.store_folder is not None:
        kinds["unfinished"] += sum(1 for _ in settings.store_folder.rglob("*#*"))
    return {
        "files_missing": len(held - present),
        "orphans": sum(kinds.values()),
        "orphans_by_kind": {k: n for k, n in kinds.items() if n},
    }


def _digests_in(values: Iterable[Any]) -> set[str]:
    """Every text of 64 characters below some JSON values: digests of files that a result speaks of."""
    found: set[str] = set()
    waiting = list(values)
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict):
            waiting.extend(value.values())
        elif isinstance(value, list):
            waiting.extend(value)
        elif isinstance(value, str) and len(value) == 64:
            found.add(value)
    return found
