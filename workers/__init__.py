"""Executes shards of jobs: the Celery application, the lease's context, one file per kind of work.

The database is the state machine and Celery only executes. A message carries a shard's id and nothing else;
who holds the shard is decided by a lease in the database, never by the broker. ``torch`` and ``warp`` are
imported inside a task: a process that forks must not have used either.
"""
