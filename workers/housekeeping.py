"""What nobody needs any more is removed, now and then, by the dispatcher: scratch files and episodes without a row."""

from __future__ import annotations

from datetime import timedelta

from sqlalchemy import select

from physworld_schemas.job import TERMINAL_STATES
from physworld_storage import resources
from physworld_storage.clock import database_now
from physworld_storage.database import Database
from physworld_storage.scratch import ScratchStore
from physworld_storage.settings import Settings
from physworld_storage.tables import DatasetRow, JobRow

FAILED_KEPT = timedelta(days=7)  # journals and checkpoints of a failed job
SWEPT_FOR = timedelta(days=1)  # a dataset that failed or was cancelled, so long after its end


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
    from physworld_storage.episodes import EpisodeStore  # zarr, which the dispatcher seldom needs

    episodes = EpisodeStore(settings)
    return [path for dataset_id, paths in kept.items() for path in episodes.remove_orphans(dataset_id, paths)]
