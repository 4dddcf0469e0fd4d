"""Prometheus figures: requests and their latency, jobs by state, shards by queue and state.

The job and shard figures are counted in the database when a scrape asks for them, so that every web process
tells the same truth and none of them keeps books. While the database does not answer within ``COUNT_S``, they are left
out and ``physworld_database_up`` is 0.
"""

from __future__ import annotations

from collections import Counter as Tally
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from physworld_services.api.probes import Probe
from physworld_storage.database import Database
from physworld_storage.errors import StorageError
from physworld_storage.jobs.kinds import SHARDS
from physworld_storage.jobs.shards import count_jobs, count_shards

WAITING = "QUEUED"
COUNT_S = 2.0
Counts = tuple[dict[tuple[str, str], int], dict[tuple[str, str], int]]
_LATENCY_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)


class Metrics:
    """The figures of one web process, in a registry of its own.

    Attributes:
        requests: counter by method, route template and status.
        latency: histogram of seconds from the first byte in to the last byte out.
    """

    def __init__(self, database: Database) -> None:
        self._registry = CollectorRegistry()
        self.requests = Counter(
            "physworld_requests", "HTTP requests", ["method", "route", "status"], registry=self._registry
        )
        self.latency = Histogram(
            "physworld_request_seconds",
            "Seconds from the first byte in to the last byte out",
            ["method", "route"],
            buckets=_LATENCY_BUCKETS_S,
            registry=self._registry,
        )
        self._database = database
        self._count = Probe("count", self._counted)

    async def exposition(self) -> bytes:
        """All figures in the Prometheus text format."""
        try:
            counts = await self._count.answer(COUNT_S)
        except (StorageError, TimeoutError):
            counts = None
        figures = CollectorRegistry()
        figures.register(_DatabaseFigures(counts))
        return generate_latest(self._registry) + generate_latest(figures)

    def _counted(self) -> Counts:
        """Jobs and shards as the database has them now, in one reading transaction."""
        with self._database.reading() as session:
            return count_jobs(session), count_shards(session)


class _DatabaseFigures(Collector):
    """Jobs and shards as they were counted for one scrape; None: the database did not answer."""

    def __init__(self, counts: Counts | None) -> None:
        self._counts = counts

    def collect(self) -> Iterator[Metric]:
        """The figures of the scrape."""
        yield GaugeMetricFamily(
            "physworld_database_up", "1 if the database answered", value=float(self._counts is not None)
        )
        if self._counts is None:
            return
        jobs, shards = self._counts
        by_job, by_shard, depth = _jobs(), _shards(), _depth()
        for (kind, state), count in sorted(jobs.items()):
            by_job.add_metric([kind, state], count)
        waiting = Tally(dict.fromkeys((shard.queue for shard in SHARDS.values()), 0))
        for (kind, state), count in sorted(shards.items()):
            by_shard.add_metric([SHARDS[kind].queue, kind, state.lower()], count)
            waiting[SHARDS[kind].queue] += count if state == WAITING else 0
        for queue, count in sorted(waiting.items()):
            depth.add_metric([queue], count)
        yield from (by_job, by_shard, depth)


def _jobs() -> GaugeMetricFamily:
    return GaugeMetricFamily("physworld_jobs", "Jobs", labels=["kind", "state"])


def _shards() -> GaugeMetricFamily:
    return GaugeMetricFamily("physworld_shards", "Shards", labels=["queue", "kind", "state"])


def _depth() -> GaugeMetricFamily:
    return GaugeMetricFamily(
        "physworld_queue_depth", "Shards that wait for a worker, published or not", labels=["queue"]
    )
