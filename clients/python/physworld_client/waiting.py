"""The rules of waiting for a job, shared by both clients: patience, when to look, what the end means."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from physworld_client.errors import JobCancelled, JobFailed
from physworld_client.types import Job

LOOK_INTERVAL_S = 0.2
LONG_POLL_S = 30.0
WATCHED_POLL_S = 2.0


class Patience:
    """How long to wait still, and whom to tell what was seen.

    Args:
        timeout: seconds, None for ever.
        on_progress: called when the job's state or progress has changed since the last look.
    """

    def __init__(self, timeout: float | None, on_progress: Callable[[Job], None] | None) -> None:
        self.timeout_s = math.inf if timeout is None else timeout
        self._end = time.monotonic() + self.timeout_s
        self._on_progress = on_progress
        self._shown: Job | None = None
        self._looked = -math.inf

    def left_s(self) -> float:
        """Seconds left, zero or less when the patience is out."""
        return self._end - time.monotonic()

    def poll_s(self) -> float:
        """Seconds for one long poll: short when somebody watches the progress."""
        longest = LONG_POLL_S if self._on_progress is None else WATCHED_POLL_S
        return max(0.1, min(longest, self.left_s()))

    def wants_look(self) -> bool:
        """Whether an event is reason enough to ask for the job again."""
        return self._on_progress is not None and time.monotonic() - self._looked >= LOOK_INTERVAL_S

    def see(self, job: Job) -> Job:
        """Takes note of the job as it is now, and tells of it when it changed."""
        self._looked = time.monotonic()
        shown = self._shown
        if self._on_progress and (
            shown is None or (job.state, job.progress) != (shown.state, shown.progress)
        ):
            self._shown = job
            self._on_progress(job)
        return job


def job_id_of(job: Job | str) -> str:
    """The id of a job given as an object or by its id."""
    return job if isinstance(job, str) else job.id


def require_success(job: Job) -> Job:
    """The job, when it succeeded.

    Raises:
        JobFailed, JobCancelled: it ended otherwise.
    """
    if job.state == "failed":
        raise JobFailed(job)
    if job.state == "cancelled":
        raise JobCancelled(job)
    return job
