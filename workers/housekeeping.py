"""What nobody needs any more is removed from the store: scratch files, and episodes and artifacts without a row.

The dispatcher lets it be done in a thread beside its own work, since a store may be large, slow or silent.
"""

from __future__ import annotations

import logging
import threading
import time
from datetime import timedelta

from sqlalchemy import select

from schemas.job import TERMINAL_STATES
from storage import resources
from storage.clock import database_now
from storage.database import Database
from storage.errors import StorageError
from storage.orphans import remove_orphan_artifacts
from storage.scratch import ScratchStore
from storage.settings import Settings
from storage.tables import DatasetRow, JobRow

logger = logging.getLogger(__name__)

ARTIFACTS_EVERY_S = 86400.0  # all of them are listed
FAILED_KEPT = timedelta(days=7)  # journals and checkpoints of a failed job
SWEPT_FOR = timedelta(days=1)  # a dataset that failed or was cancelled, so long after its end


class Housekeeping:
    """One thread at a time; another begins once the last one is done."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self._settings, self._database = settings, database
        self._thread: threading.Thread | None = None
        self._artifacts_due = 0.0

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
            if time.monotonic() >= self._artifacts_due:
                removed = remove_orphan_artifacts(self._settings, self._database)
                self._artifacts_due = time.monotonic() + ARTIFACTS_EVERY_S
                if removed:
                    logger.info("removed %d artifacts that no row names", len(removed))
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


def remove_orphan_episodes(settings: Settings, database: Database) -> list[str]:
    """Remove files of episodes that no row names, of datasets that ended without a seal; their paths.

    A sealed dataset was tidied by its seal. Episodes with a row stay: a retry of a failed job goes on with them. A
    worker that had not yet seen the end may write once more, so a dataset is looked at for a day.
    """
    with database.reading() as session:
        since = database_now(session) - SWEPT_FOR
        ended = (JobRow.state.in_(("failed", "cancelled")), JobRow.finished_at > since)
        found = select(DatasetRow.id).join(JobRow, JobRow.id == DatasetRow.job_id).where(*ended)
        kept = {
            dataset_id: [episode.path for episode in resources.all_episodes(session, dataset_id)]
            for dataset_id in session.scalars(found)
        }
    if not kept:
        return []
    from storage.episodes import EpisodeStore  # zarr, which the dispatcher seldom needs

    episodes = EpisodeStore(settings)
    return [path for dataset_id, paths in kept.items() for path in episodes.remove_orphans(dataset_id, paths)]
