"""Errors of the workers.

::

    WorkerError
    ├── LeaseLost            another owner has the shard, or the lease ran out: stop, write nothing
    ├── Cancelled            the job was cancelled: stop, the shard ends as cancelled
    ├── UnknownShardKind     this worker has no handler for the kind
    ├── NotEnoughDisk        the estimate of what a dataset writes exceeds what is free
    └── DatasetIncomplete    at sealing, an episode is missing, twice there, or its digest differs
"""

from __future__ import annotations


class WorkerError(Exception):
    """Base of the tree; ``code`` is the stable code in the problem document."""

    code = "worker_error"


class LeaseLost(WorkerError):
    """The shard belongs to somebody else now."""

    code = "lease_lost"


class Cancelled(WorkerError):
    """Somebody cancelled the job."""

    code = "cancelled"


class UnknownShardKind(WorkerError):
    """A message reached a worker that cannot do it."""

    code = "unknown_shard_kind"


class NotEnoughDisk(WorkerError):
    """Checked before the first episode, not found out at the last."""

    code = "budget_exceeded"


class DatasetIncomplete(WorkerError):
    """The dataset cannot be sealed."""

    code = "dataset_incomplete"
