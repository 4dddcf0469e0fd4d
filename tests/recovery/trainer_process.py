"""A trainer as a process of its own: ``python trainer_process.py DATA_DIR`` works until no training waits.

What a process that was killed here before left behind is taken back first, as the supervisor does at its start.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from physworld_storage.database import open_database
from physworld_storage.jobs import leases
from physworld_storage.settings import Settings
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores

PATIENCE_S = 20.0


def main(data_dir: Path) -> int:
    """0 when every training is done; 1 when one failed or waits for too long."""
    settings = Settings(data_dir=data_dir, lease_seconds=20.0)
    database = open_database(settings)
    runtime = Runtime(settings, database, Stores(settings, database), process_owner())
    for take_back in (leases.recover, leases.reap):
        with database.session() as session:
            take_back(session)
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        with database.reading() as session:
            waiting = leases.publishable(session)
        for publication in waiting:
            return 0 if run_shard(runtime, publication.shard_id) == "done" else 1
        time.sleep(0.1)
    return 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
