"""Artifacts that no row names are removed: an attempt that was lost wrote them before it could commit.

An artifact has its digest for a name, so bytes that a lost attempt left may be just those that another is about to
commit. That no file goes that somebody is about to name rests on three things:

- ``ArtifactStore`` writes a file each time it is put, also where it is there already. So the time of its last write,
  by the store's own clock, is not before the beginning of any attempt that put it.
- Only a file goes whose last write lies ``Settings.orphan_seconds`` before now and before the claim of every shard
  that runs, however long that has been; the age is there for requests that put a file and then make its row, and for
  the difference between the clocks of store and database. An attempt that has lost its lease can commit nothing.
- Each file is looked at once more right before it goes, since it may have been put again meanwhile.

Lost attempts leave a file now and then. Where most files have no row, the store belongs to another database as well, or
the settings name the wrong one: then nothing goes, and the log says so.

What is left is the moment between that last look and the removal: whoever puts the very bytes of a file that nobody
named for a day, within it, would have to write them again. Objects have no removal that depends on their age.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from physworld_storage.artifacts import SHA256, ArtifactStore
from physworld_storage.clock import database_now
from physworld_storage.database import Database
from physworld_storage.jobs.shards import RUNNING
from physworld_storage.settings import Settings
from physworld_storage.tables import (
    AssessmentRow,
    DatasetRow,
    FitRow,
    ModelVersionRow,
    RunRow,
    SceneRow,
    ShardRow,
    TraceRow,
    VideoRow,
)

NAMING = (
    *(row.artifacts for row in (SceneRow, FitRow, TraceRow, DatasetRow, ModelVersionRow, RunRow, VideoRow)),
    DatasetRow.digest,
    ModelVersionRow.sha256,
    AssessmentRow.figures,
)
MANY = ("episode", "simulation")
"""Kinds of shards that a job has by the thousand; they put no artifacts."""
ROWS_AT_A_TIME = 1000
FEW, SHARE = 20, 0.1
"""So many files without a row, or such a share of all, may be of lost attempts."""

logger = logging.getLogger(__name__)


def remove_orphan_artifacts(settings: Settings, database: Database) -> list[str]:
    """Remove the artifacts that no row names and nobody is about to name; their digests."""
    artifacts = ArtifactStore(settings)
    with database.reading() as session:
        before = _nobody_writes_before(session, timedelta(seconds=settings.orphan_seconds))
    if before is None:
        return []
    artifacts.remove_unfinished(before)
    old = set(artifacts.last_written_before(before))
    if not old:
        return []
    with database.reading() as session:
        orphans = old.difference(_named(session))
    if len(orphans) > max(FEW, SHARE * len(old)):
        told = (
            "%d of %d artifacts have no row in this database, none is removed: is the store another's, too?"
        )
        logger.error(told, len(orphans), len(old))
        return []
    return [sha256 for sha256 in sorted(orphans) if artifacts.remove_if_written_before(sha256, before)]


def _nobody_writes_before(session: Session, age: timedelta) -> datetime | None:
    """Files last written before this time are of no attempt that goes on. None: the beginning of one is unknown."""
    running = select(func.min(ShardRow.claimed_at), func.count(), func.count(ShardRow.claimed_at))
    first, shards, claimed = session.execute(running.where(ShardRow.state == RUNNING)).one()
    if claimed < shards:  # after a restart of the whole service, for a moment
        return None
    now = database_now(session)
    return (now if first is None else min(now, first)) - age


def _named(session: Session) -> Iterator[str]:
    """The digest of every file that a row names, or that the work of a shard was given or has told."""
    shards = (ShardRow.payload, ShardRow.result)
    statements = [select(column) for column in NAMING]
    statements += [select(column).where(ShardRow.kind.not_in(MANY)) for column in shards]
    for statement in statements:
        yield from _digests(session.scalars(statement.execution_options(yield_per=ROWS_AT_A_TIME)))


def _digests(values: Iterable[Any]) -> Iterator[str]:
    """Every text below some JSON values that is a SHA-256."""
    for value in values:
        if isinstance(value, dict):
            yield from _digests(value.values())
        elif isinstance(value, list):
            yield from _digests(value)
        elif isinstance(value, str) and SHA256.fullmatch(value):
            yield value
