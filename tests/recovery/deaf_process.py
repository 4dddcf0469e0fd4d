"""A worker whose work hears nothing: ``python deaf_process.py DATA SHARD`` takes the shard and stays in native code."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

from physworld_storage.database import open_database
from physworld_storage.settings import Settings
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.execute import Runtime, end_process, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores

FOR_S = 300


def deaf(context: TaskContext, stores: Stores) -> HandlerResult:
    """Native code that takes long, as a compiler does: no exception reaches it, and it asks nobody."""
    ctypes.CDLL(None).sleep(FOR_S)
    raise AssertionError("nobody ended this")


if __name__ == "__main__":
    settings = Settings(data_dir=Path(sys.argv[1]))
    database = open_database(settings)
    stores = Stores(settings, database)
    runtime = Runtime(settings, database, stores, process_owner(), lambda kind: deaf, end_process)
    print(run_shard(runtime, sys.argv[2]))
