"""A worker whose work kills it: ``python deadly_process.py DATA SHARD`` takes the shard and dies of it by SIGSEGV."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

from physworld_storage.database import open_database
from physworld_storage.settings import Settings
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores


def deadly(context: TaskContext, stores: Stores) -> HandlerResult:
    """Native code that fails."""
    os.kill(os.getpid(), signal.SIGSEGV)
    raise AssertionError("still alive")


if __name__ == "__main__":
    settings = Settings(data_dir=Path(sys.argv[1]))
    database = open_database(settings)
    runtime = Runtime(settings, database, Stores(settings, database), process_owner(), lambda kind: deadly)
    print(run_shard(runtime, sys.argv[2]))
