"""Moves work from the database to the broker, and back when somebody dies: ``python -m physworld_workers.dispatcher``.

Whenever somebody commits (``physworld_storage.changes``), ten times a second at most: publish the shards that wait (an
outbox: publish first, then mark; a crash in between publishes twice, which a claim by compare-and-set makes harmless).
Every second while shards wait or run: publish those whose time has come, take back leases that ran out, at once those
whose owner on this host is provably dead, and look how deep the broker's queues are. While there is no work: one
question to the database every two seconds, should a change have gone unheard, and none to the broker. Every five
minutes: forget the idempotency keys of more than a day ago, and let the store be tidied up
(``physworld_workers.housekeeping``).

A queue that is empty in two looks while shards of it wait has lost their messages: they are published again
after two seconds instead of ``republish_seconds``. A queue that is deep gets nothing more, so the broker
never holds more than a screenful of repeated messages, whatever happens.

Several dispatchers do the same work twice and no harm.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import FrameType

from celery import Celery
from kombu.exceptions import OperationalError as BrokerError
from redis.exceptions import RedisError

from physworld_schemas.queues import INFERENCE, SIMULATION, TASK_NAME, TRAINING
from physworld_storage import idempotency
from physworld_storage.changes import Changes
from physworld_storage.database import Database, open_database
from physworld_storage.errors import DatabaseUnavailable, StoreError
from physworld_storage.jobs import leases
from physworld_storage.settings import Settings, get_settings
from physworld_workers.app import READY_FILE_VARIABLE, create_app
from physworld_workers.housekeeping import Housekeeping
from physworld_workers.owner import owner_is_gone

logger = logging.getLogger(__name__)

TICK_S = 0.1
SWEEP_S = 1.0
IDLE_SWEEP_S = 2.0
FORGET_EVERY_S = 300.0
IDEMPOTENCY_KEPT = timedelta(hours=24)
LARGE_ANSWER_BYTES, LARGE_ANSWERS_KEPT = 64 * 1024, timedelta(minutes=15)
"""Rollouts answer with up to some MiB, many times a minute: kept for as long as a client tries again."""
LOST_AFTER_S = 2.0
PAUSE_AFTER_ERROR_S = 1.0
STOP_WITHIN_S = 2.0
BROKER_SILENCE = {"socket_timeout": 5.0}
"""Of the dispatcher, whose commands are answered at once; a worker waits longer in commands that block."""
MAX_DEPTH = 64
"""Messages of one queue in the broker at a time."""


class Dispatcher:
    """One pass is ``tick``; ``run`` repeats it until ``stop`` is set."""

    def __init__(self, settings: Settings, database: Database, app: Celery) -> None:
        self._settings = settings
        self._database = database
        self._changes = Changes(database)
        self.housekeeping = Housekeeping(settings, database)
        self._app = app
        self._connection = app.connection_for_write(transport_options=BROKER_SILENCE)
        self._depth = dict.fromkeys((SIMULATION, TRAINING, INFERENCE), 0)
        self._empty_looks = dict.fromkeys((SIMULATION, TRAINING, INFERENCE), 0)
        self._sweep_due = 0.0
        self._forget_due = 0.0

    def run(self, stop: threading.Event) -> None:
        """Tick until told to stop; a broker or database that is away, or takes nothing, is waited for."""
        while not stop.is_set():
            try:
                self._changes.wait(self._due_in(), stop)
                self.tick()
            except (BrokerError, RedisError, *self._connection.connection_errors) as error:
                logger.warning("broker away or full: %s", error)
                self._connection.close()
                self._connection = self._app.connection_for_write(transport_options=BROKER_SILENCE)
                stop.wait(PAUSE_AFTER_ERROR_S)
            except (DatabaseUnavailable, StoreError) as error:
                logger.warning("database or store away: %s", error)
                stop.wait(PAUSE_AFTER_ERROR_S)
            stop.wait(TICK_S)
        self.housekeeping.wait(STOP_WITHIN_S)
        self._changes.close()

    def tick(self) -> None:
        """One pass."""
        waiting = self._sweep() if time.monotonic() >= self._sweep_due else True
        if waiting:
            self._publish(self._settings.republish_seconds, set(self._depth))
        if time.monotonic() >= self._forget_due:
            self._forget_due = time.monotonic() + FORGET_EVERY_S
            self._forget_old_keys()
            self.housekeeping.begin()

    def _due_in(self) -> float:
        """Seconds until there is something to do although nobody has committed."""
        return max(0.0, min(self._sweep_due, self._forget_due) - time.monotonic())

    def _sweep(self) -> bool:
        """What has to be looked at now and then; whether shards wait. The next look is due sooner where they do."""
        with self._database.reading() as session:
            waiting, running = leases.open_work(session)
        self._sweep_due = time.monotonic() + (SWEEP_S if waiting or running else IDLE_SWEEP_S)
        if waiting or running:
            waiting |= self._take_back() > 0
        if waiting:
            self._look_at_queues()
            lost_in = {queue for queue, looks in self._empty_looks.items() if looks >= 2}
            self._publish(LOST_AFTER_S, lost_in)
        else:  # what the broker still holds repeats what was done
            self._depth = dict.fromkeys(self._depth, 0)
            self._empty_looks = dict.fromkeys(self._empty_looks, 0)
        return waiting

    def _publish(self, republish_seconds: float, queues: set[str]) -> None:
        open_queues = {queue for queue in queues if self._depth[queue] < MAX_DEPTH}
        if not open_queues:
            return
        with self._database.reading() as session:
            found = leases.publishable(session, republish_seconds=republish_seconds, window=MAX_DEPTH)
        waiting = [publication for publication in found if publication.queue in open_queues]
        if not waiting:
            return
        with self._app.amqp.Producer(self._connection, auto_declare=False) as producer:
            for publication in waiting:
                self._app.send_task(
                    TASK_NAME,
                    args=[publication.shard_id],
                    queue=publication.queue,
                    producer=producer,
                    retry=False,
                )
                self._depth[publication.queue] += 1
        with self._database.session() as session:
            leases.mark_published(session, waiting)
        self._sweep_due = min(self._sweep_due, time.monotonic() + SWEEP_S)
        logger.info("published %d shards", len(waiting))

    def _take_back(self) -> int:
        with self._database.session() as session:
            leases.end_leases_of(session, owner_is_gone)
            taken = leases.reap(session)
        if taken:
            logger.warning("took back %d shards: %s", len(taken), ", ".join(taken))
        return len(taken)

    def _forget_old_keys(self) -> None:
        now = datetime.now(UTC)
        with self._database.session() as session:
            old = idempotency.forget(session, now - IDEMPOTENCY_KEPT)
            large = idempotency.forget(session, now - LARGE_ANSWERS_KEPT, LARGE_ANSWER_BYTES)
        if old or large:
            logger.info("forgot %d idempotency keys older than %s", old, IDEMPOTENCY_KEPT)
            logger.info("forgot %d with large answers older than %s", large, LARGE_ANSWERS_KEPT)

    def _look_at_queues(self) -> None:
        channel = self._connection.default_channel
        for queue in self._depth:
            depth = channel.queue_declare(queue=queue, durable=True, auto_delete=False).message_count
            self._depth[queue] = depth
            self._empty_looks[queue] = 0 if depth else self._empty_looks[queue] + 1


def main() -> int:
    """Run until SIGTERM or SIGINT."""
    settings = get_settings()
    settings.check()
    logging.basicConfig(
        level=settings.log_level.upper(), format="%(asctime)s %(levelname)s %(name)s %(message)s"
    )
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGTERM, on_signal)
    signal.signal(signal.SIGINT, on_signal)
    dispatcher = Dispatcher(settings, open_database(settings), create_app(settings))
    ready_file = os.environ.get(READY_FILE_VARIABLE)
    if ready_file:
        Path(ready_file).write_text(f"{os.getpid()}\n")
    dispatcher.run(stop)
    return 0


if __name__ == "__main__":
    sys.exit(main())
