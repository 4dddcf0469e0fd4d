"""The Celery application: one task, configured so that the broker can lose, repeat or delay any message.

What each setting is for:

* ``acks_late`` + ``reject_on_worker_lost``: a message outlives the worker that took it. Redelivery has no
  limit in Celery; attempts are counted and capped in the database.
* ``visibility_timeout`` above the hard time limit: below it, a running task would be handed out a second
  time. Recovery never waits for it: the dispatcher publishes again from the database.
* ``prefetch 1``: a message that a busy worker sits on is a message that an idle worker lacks.
* results ignored: Celery's states are not the truth (a lost connection leaves finished tasks REVOKED).
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
from pathlib import Path
from typing import Any

from celery import Celery, signals
from kombu.entity import Exchange, Queue

from physworld_schemas.queues import INFERENCE, SIMULATION, TASK_NAME, TRAINING
from physworld_storage.settings import Settings

HARD_LIMIT_S = 12 * 3600
SOFT_LIMIT_S = HARD_LIMIT_S - 60
VISIBILITY_TIMEOUT_S = HARD_LIMIT_S + 3600
TASKS_PER_CHILD = 1000  # a fresh process loads the physics kernels again, which takes seconds
EXCHANGE = Exchange("physworld", type="direct")  # type: ignore[no-untyped-call]  # kombu has no types
READY_FILE_VARIABLE = "PHYSWORLD_READY_FILE"
HEAVY_MODULES = ("torch", "warp")


def create_app(settings: Settings) -> Celery:
    """The application for ``settings.broker_url`` (any Redis-protocol server)."""
    if settings.broker_url is None:
        raise ValueError("PHYSWORLD_BROKER_URL is not set: workers and dispatcher need a broker")
    app = Celery("physworld", broker=settings.broker_url.get_secret_value(), set_as_current=False)
    app.conf.update(
        accept_content=["json"],
        broker_connection_max_retries=None,
        broker_connection_retry_on_startup=True,
        broker_transport_options=transport_options(settings.broker_prefix),
        enable_utc=True,
        result_accept_content=["json"],
        task_acks_late=True,
        task_create_missing_queues=False,
        task_default_queue=SIMULATION,
        task_ignore_result=True,
        task_queues=[
            Queue(name, EXCHANGE, routing_key=name)  # type: ignore[no-untyped-call]  # kombu has no types
            for name in (SIMULATION, TRAINING, INFERENCE)
        ],
        task_reject_on_worker_lost=True,
        task_serializer="json",
        task_soft_time_limit=SOFT_LIMIT_S,
        task_time_limit=HARD_LIMIT_S,
        task_track_started=False,
        worker_cancel_long_running_tasks_on_connection_loss=False,
        worker_enable_prefetch_count_reduction=False,
        worker_max_tasks_per_child=TASKS_PER_CHILD,
        worker_prefetch_multiplier=1,
        worker_redirect_stdouts=False,
        worker_send_task_events=False,
    )
    app.task(_run_shard, name=TASK_NAME, shared=False)
    return app


def transport_options(prefix: str = "") -> dict[str, Any]:
    """Options of kombu's Redis transport; ``prefix`` keeps installations apart that share a broker."""
    return {
        "global_keyprefix": prefix,
        "health_check_interval": 10,
        "queue_order_strategy": "priority",
        "socket_connect_timeout": 5,
        "socket_keepalive": True,
        "socket_timeout": 30,
        "unacked_restore_interval": 10,
        "unacked_restore_throttle": 1,
        "visibility_timeout": VISIBILITY_TIMEOUT_S,
    }


def run_worker(settings: Settings, queue: str, name: str) -> int:
    """Serve one queue with one warm child process until told to stop; returns the exit code.

    The worker is built here rather than by Celery's command line, whose imports take as long as its own.
    """
    logging.getLogger("alembic").setLevel(logging.WARNING)
    app = create_app(settings)
    signals.worker_init.connect(_refuse_heavy_modules, weak=False)
    signals.worker_process_init.connect(_die_with_parent, weak=False)
    signals.worker_ready.connect(_announce, weak=False)
    worker = app.Worker(
        pool_cls="prefork",
        concurrency=1,
        queues=[queue],
        hostname=f"{name}@{socket.gethostname()}",
        loglevel=settings.log_level.upper(),
        without_gossip=True,
        without_mingle=True,
    )
    worker.start()
    return int(worker.exitcode or 0)


def _run_shard(shard_id: str) -> None:
    from physworld_workers.execute import process_runtime, run_shard

    run_shard(process_runtime(), shard_id)


def _refuse_heavy_modules(**_: Any) -> None:
    loaded = [name for name in HEAVY_MODULES if name in sys.modules]
    if loaded:
        raise RuntimeError(f"{', '.join(loaded)} loaded before the fork: a child that uses it would hang")


def _die_with_parent(**_: Any) -> None:
    """A pool process must not go on computing for a worker that was killed."""
    if sys.platform == "linux":
        import ctypes

        parent_death_signal = 1  # PR_SET_PDEATHSIG
        ctypes.CDLL(None, use_errno=True).prctl(parent_death_signal, signal.SIGKILL)


def _announce(**_: Any) -> None:
    path = os.environ.get(READY_FILE_VARIABLE)
    if path:
        Path(path).write_text(f"{os.getpid()}\n")
