"""A process on a host whose clock is wrong: ``wrong_clock.py SECONDS dispatch`` or ``SECONDS claim SHARD SECONDS``.

Every module of the service that reads the time through ``datetime`` gets one that is SECONDS ahead (behind, if
negative). The settings come from the environment, as for every process of the service.
"""

from __future__ import annotations

import datetime
import sys
from typing import Any

import physworld_storage.tables
import physworld_workers.dispatcher
from physworld_storage.database import open_database
from physworld_storage.jobs import leases
from physworld_storage.settings import get_settings


def put_wrong(seconds: float) -> None:
    """Let the loaded modules of the service read a clock that is so many seconds ahead."""
    right = datetime.datetime

    class Wrong(right):
        @classmethod
        def now(cls, tz: datetime.tzinfo | None = None) -> datetime.datetime:
            return right.now(tz) + datetime.timedelta(seconds=seconds)

    for name, module in list(sys.modules.items()):
        if (
            name.partition(".")[0] in {"physworld_storage", "physworld_workers"}
            and vars(module).get("datetime") is right
        ):
            vars(module)["datetime"] = Wrong
    assert abs((physworld_storage.tables.utc_now() - right.now(datetime.UTC)).total_seconds() - seconds) < 5.0


def claim(shard_id: str, lease_seconds: float) -> Any:
    """Take the shard and renew the lease once."""
    database = open_database(get_settings())
    with database.session() as session:
        lease = leases.claim(session, shard_id, "elsewhere/1/1/1", lease_seconds)
        assert lease is not None
        assert leases.renew(session, lease, lease_seconds) == "held"


if __name__ == "__main__":
    put_wrong(float(sys.argv[1]))
    if sys.argv[2] == "dispatch":
        sys.exit(physworld_workers.dispatcher.main())
    claim(sys.argv[3], float(sys.argv[4]))
