"""What nobody needs any more is removed from the store: scratch files, and episodes and artifacts without a row.

The dispatcher lets it be done in a thread beside its own work, since a store may be large, slow or silent.
"""

from __future__ import annotations

import logging
import threading
import time
from datetime import timedelta

from sqlalchemy import select

from physworld_schemas.job import TERMINAL_STATES
from physworld_storage import resources
from physworld_storage.clock import database_now
from physworld_storage.database import Database
from physworld_storage.errors import StorageError
from physworld_storage.jobs.kinds import tracking
from physworld_storage.orphans import remove_orphan_artifacts
from physworld_storage.scratch import ScratchStore
from physworld_storage.settings import Settings
from physworld_storage.tables import DatasetRow, JobRow

logger = logging.getLogger(__name__)

ALL_EVERY_S = 86400.0  # of all artifacts and all sealed datasets, which may be many
FAILED_KEPT = timedelta(days=7)  # journals, checkpoints and uploaded pictures of a failed job
SWEPT_FOR = timedelta(days=1)  # a dataset, so long after its end


class Housekeeping:
    """One thread at a time; another begins once the last one is done."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self._settings, self._database = settings, database
        self._thread: threading.Thread | None = None
        self._all_due = 0.0

    def begin(self) -> None:
        """Tidy up in the background, unless that still goes on."""
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._tidy, name="housekeeping", daemon=True)
            self._thread.start()

    def wait(self, seconds: float) -> None:
        """Wait for what was begun, at most so long; it may be broken off at any time."""
        if self._thread is not None:
            self._thread.join(seconds)

    def _tidy(self) -> None:
        try:
            remove_ended_scratch(ScratchStore(self._settings), self._database)
            remove_orphan_episodes(self._settings, self._database)
            if time.monotonic() >= self._all_due:
                episodes = remove_orphan_episodes(self._settings, self._database, sealed=True)
                with self._database.session() as session:
                    tracking.forget_uploads(session, database_now(session) - FAILED_KEPT)
                removed = remove_orphan_artifacts(self._settings, self._database)
                self._all_due = time.monotonic() + ALL_EVERY_S
                if episodes or removed:
                    told = "removed %d episodes and %d artifacts that no row names"
                    logger.info(told, len(episodes), len(removed))
        except StorageError as error:
            logger.warning("not everything was tidied up: %s", error)


def remove_ended_scratch(scratch: ScratchStore, database: Database) -> list[str]:
    """Remove scratch files of jobs that have ended; the jobs. A failed one keeps them a while, for a retry."""
    ended = []
    for job_id in scratch.jobs():
        with database.reading() as session:
            job = session.get(JobRow, job_id)
            since = (
                None if job is None or job.finished_at is None else database_now(session) - job.finished_at
            )
        may_be_retried = job is not None and job.state == "failed" and (since is None or since < FAILED_KEPT)
        if job is None or (job.state in TERMINAL_STATES and not may_be_retried):
            scratch.remove(job_id)
            ended.append(job_id)
    return ended


def remove_orphan_episodes(settings: Settings, database: Database, *, sealed: bool = False) -> list[str]:
    """Remove files of episodes that no row names, of datasets that ended without a seal, or with one; their paths.

    Episodes with a row stay: a retry of a failed job goes on with them. A worker that had not yet seen the end, or was
    stopped when a seal tidied up, may write once more, so a dataset is looked at for a day after its end, and for two
    where that is done once a day.
    """
    states = ("succeeded",) if sealed else ("failed", "cancelled")
    with database.reading() as session:
        since = database_now(session) - (2 if sealed else 1) * SWEPT_FOR
        ended = (JobRow.state.in_(states), JobRow.finished_at > since)
        found = select(DatasetRow.id).join(JobRow, JobRow.id == DatasetRow.job_id).where(*ended)
        kept = {
            dataset_id: [episode.path for episode in resources.all_episodes(session, dataset_id)]
            for dataset_id in session.scalars(found)
        }
    if not kept:
        return []
    from physworld_storage.episodes import EpisodeStore  # zarr, which the dispatcher seldom needs

    episodes = EpisodeStore(settings)
    return [path for dataset_id, paths in kept.items() for path in episodes.remove_orphans(dataset_id, paths)]
