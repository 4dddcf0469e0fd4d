"""Whether the time left that a job tells is what was left: pipelines of the sample scene, looked at when they ended.

``python -m benchmarks.service.time_left [--json FILE]`` runs a pipeline without and one with a trace through the real
embedded service, two workers and the trainer, each twice: the first time nothing like it has run there, the second
time it can be told how the first went. Every event of the pipelines and of their jobs has its time, so that for
each second of a job what it told then (`eta_s`, counted down since it was told, as a reader would) stands beside the
time until the event that ended it.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from physworld_client import Client

from benchmarks.harness import Report, run_alone
from benchmarks.service.factory import SCENE, service
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Event, Job
from physworld_schemas.model import TrainingConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceConfig

FIT = FitConfig(max_simulations=120, particle_budget=500)
DATASET = DatasetConfig(episodes=20)
TRAINING = TrainingConfig(hidden=32, vertices=50, steps=60)
TRACE = TraceConfig(candidates=["air_drag_linear", "viscosity_kelvin_voigt"], confirmed=2, iterations=2)
FACTOR = 1.5
JOB_S = 3600.0
STEP_S = 1.0
END = 0.95
"""Of a job's time: what is left after it is a few seconds, of which a factor says nothing."""


@dataclass(frozen=True)
class Told:
    """What one job told of its time left.

    Attributes:
        kind: of the job.
        lasted_s: from its start to its end [s].
        factors: told over real, one a second of the first ``END`` of its time in which it told anything.
        silent: share of that time in which it told nothing, 0 to 1.
    """

    kind: str
    lasted_s: float
    factors: tuple[float, ...]
    silent: float

    @property
    def within(self) -> float:
        """Share of the time with a word in which it was within ``FACTOR`` of the truth, 0 to 1."""
        near = [1 / FACTOR <= factor <= FACTOR for factor in self.factors]
        return sum(near) / len(near) if near else 0.0


def told(kind: str, events: Sequence[Event]) -> Told:
    """What a job told of its time left, against when it ended.

    Args:
        kind: of the job.
        events: all of its events, in their order.

    Raises:
        ValueError: the events have no start and no end.
    """
    states = {event.data["state"]: event.at for event in events if event.type == "state"}
    if not {"running", "succeeded"} <= set(states):
        raise ValueError(
            f"a {kind} job that went through {', '.join(states)} has no start and end to measure"
        )
    start, end = states["running"], states["succeeded"]
    lasted_s = (end - start).total_seconds()
    words = [
        ((event.at - start).total_seconds(), event.data.get("eta_s"))
        for event in events
        if event.type == "progress" and event.at >= start
    ]
    factors, silent, at_s, seconds = [], 0, STEP_S, 0
    while at_s <= END * lasted_s:
        seconds += 1
        before = [word for word in words if word[0] <= at_s]
        if not before or before[-1][1] is None:
            silent += 1
        else:
            moment_s, left_s = before[-1]
            factors.append(max(left_s - (at_s - moment_s), 0.0) / (lasted_s - at_s))
        at_s += STEP_S
    return Told(kind, lasted_s, tuple(factors), silent / seconds if seconds else 0.0)


def measure(repeats: int, seed: int) -> Report:
    """Two pipelines of each kind on one service that begins empty; ``repeats`` is of no use here."""
    found: list[tuple[str, Told]] = []
    with tempfile.TemporaryDirectory(prefix="physworld-bench-") as folder:
        with service(Path(folder), 2, trainer=True) as client:
            scene = client.scenes.create(SCENE)
            for name, traced in (
                ("first", False),
                ("again", False),
                ("first, with a trace", True),
                ("again, with a trace", True),
            ):
                request = PipelineCreate(
                    scene_id=scene.id, model_name="left", fit=FIT, dataset=DATASET, training=TRAINING, trace=TRACE,
                    close_the_loop=traced, compare=False,
                )  # fmt: skip
                job = client.jobs.wait(client.pipelines.create(request), timeout=JOB_S)
                found += [(f"{one.kind}, {name}", one) for one in _family(client, job)]
    rows = [
        [
            name,
            f"{one.lasted_s:.0f}",
            f"{100 * one.silent:.0f} %",
            f"{statistics.median(one.factors):.2f}" if one.factors else "-",
            f"{100 * one.within:.0f} %" if one.factors else "-",
        ]
        for name, one in found
    ]
    return Report(
        name="service.time_left",
        title="The time left that a job tells",
        figures={
            name: {
                "lasted_s": one.lasted_s,
                "silent": one.silent,
                "within": one.within,
                "factors": one.factors,
            }
            for name, one in found
        },
        header=[
            "job",
            "lasted [s]",
            "told nothing",
            "told over real, median",
            f"within a factor of {FACTOR:g}",
        ],
        rows=rows,
        notes=[
            "Four pipelines, one after another on a service that was empty before. A pipeline called `first` has no "
            "example of its kind; of those with a trace, the jobs of other kinds have.",
            f"Sample scene, two workers and the trainer; one look a second over the first {100 * END:.0f} % of each "
            "job. The last two columns are of the time in which it told something.",
        ],
        seed=seed,
    )


def _family(client: Client, job: Job) -> list[Told]:
    """What the pipeline told, and what each of its jobs did."""
    jobs = [client.jobs.get(job.id), *(client.jobs.get(child) for child in client.jobs.get(job.id).children)]
    found = []
    for one in jobs:
        events = list(client.jobs.events(one.id))
        found.append(told(one.kind, events))
    return found


if __name__ == "__main__":
    run_alone(measure)
