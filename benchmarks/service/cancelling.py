"""How long a job of each kind takes to be cancelled: from POST cancel to the state ``cancelled``.

The sample scene through the real embedded service with two workers. A job of every kind is first run to its end, which
gives what the next kind needs and how long it takes; then it is started again and cancelled at moments that are spread
over that time, so that whatever it does for long is met. The first fit runs on an empty cache of kernels, so that one
series is cancelled while they are compiled.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from physworld_client import Client
from physworld_client.calls import Call
from pydantic import TypeAdapter

from benchmarks.harness import Report, run_alone, summarise
from benchmarks.service.factory import SCENE, service
from physworld_schemas.arrays import EncodedArray
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import TERMINAL_STATES, Job
from physworld_schemas.model import TrainingConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.plan import PlanConfig
from physworld_schemas.rollout import RolloutCreate
from physworld_schemas.trace import TraceConfig

WITHIN_S = 5.0
MOMENTS = 4
CANDIDATES, TICKS = 64, 300
LOOK_S = 0.05
JOB_S, CANCEL_S = 1800.0, 300.0
MODEL = "cancelled"
BEFORE_S = {"fit, no kernel compiled yet": 12.1, "fit": 2.8, "trace": 2.5, "dataset": 3.1, "training": 79.4}
"""The longest of each before decision 47, by this script on the same machine (a training of 16 steps)."""
FIT = FitConfig(max_simulations=10, particle_budget=800)
DATASET = DatasetConfig(episodes=8, frames=60)
TRAINING = TrainingConfig(steps=8, fine_tune_steps=5, hidden=32, vertices=60)
TRACE = TraceConfig(candidates=["air_drag_linear", "viscosity_kelvin_voigt"], confirmed=2, iterations=2)
TRACED = FitConfig(max_simulations=12, particle_budget=600, damping="none")


@dataclass
class Series:
    """Cancellations of one kind.

    Attributes:
        whole_s: of a job that is left to end [s].
        seconds: from POST cancel to the state ``cancelled``, one a moment [s].
        doing: what the job told when it was cancelled, one a moment.
        next_s: from the POST of the next job to its start [s].
    """

    whole_s: float
    seconds: list[float] = field(default_factory=list)
    doing: list[str] = field(default_factory=list)
    next_s: list[float] = field(default_factory=list)


def measure(repeats: int, seed: int) -> Report:
    """Cancel every kind ``MOMENTS`` times; ``repeats`` is of no use here: a moment is met once."""
    found: dict[str, Series] = {}
    with tempfile.TemporaryDirectory(prefix="physworld-bench-") as folder:
        cold = Path(folder) / "kernels"
        data = Path(folder) / "data"
        data.mkdir()
        with service(data, 2, trainer=True, environment={"WARP_CACHE_PATH": str(cold)}) as client:
            scene = client.scenes.create(SCENE)

            def fit() -> Job:
                shutil.rmtree(cold, ignore_errors=True)
                return client.fits.create(scene.id, FIT)

            found["fit, no kernel compiled yet"] = _cold(client, fit)
        with service(data, 2, trainer=True) as client:
            _all_kinds(client, scene.id, found)
    worst = max(max(one.seconds) for one in found.values())
    rows = [
        [
            name,
            f"{one.whole_s:.0f}",
            str(len(one.seconds)),
            f"{summarise(one.seconds).median:.1f}",
            f"{max(one.seconds):.1f}",
            f"{BEFORE_S[name]:.1f}" if name in BEFORE_S else "-",
            one.doing[one.seconds.index(max(one.seconds))][:60] or "-",
            f"{max(one.next_s):.1f}",
        ]
        for name, one in found.items()
    ]
    return Report(
        name="service.cancelling",
        title="Cancelling a job",
        figures={"worst_s": worst, "kinds": {name: vars(one) for name, one in found.items()}},
        header=[
            "job",
            "left alone [s]",
            "cancelled",
            "median [s]",
            "longest [s]",
            "before [s]",
            "what it did then",
            "next one begins within [s]",
        ],
        rows=rows,
        notes=[
            f"From POST cancel to `cancelled`, sample scene, two workers and the trainer; longest of all {worst:.1f} s "
            f"(target: {WITHIN_S:g} s).",
            "The last column counts from the POST of the following job of that kind: what a worker that was left "
            "behind costs is in it.",
        ],
        seed=seed,
    )


def _all_kinds(client: Client, scene_id: str, found: dict[str, Series]) -> None:
    """Every kind in the order in which each needs what the one before it made."""

    def series(name: str, start: Callable[[], Job]) -> Job:
        ended, found[name] = _series(client, start)
        return ended

    fit_id = series("fit", lambda: client.fits.create(scene_id, FIT)).outputs[0].id
    series(
        "trace",
        lambda: client.traces.create(scene_id, TRACE, fit=TRACED),
    )
    dataset_id = series("dataset", lambda: client.datasets.create(fit_id, DATASET)).outputs[0].id
    series("training", lambda: client.models.create(MODEL, dataset_id, TRAINING))
    series("assessment", lambda: client.assessments.create(MODEL, scene_id, open_trace=False))
    series("rollout", lambda: _rollout(client))
    series(
        "plan",
        lambda: client.plans.create(
            MODEL, points={0: [0.0, 0.0, 0.0]}, config=PlanConfig(horizon=60, samples=512, iterations=10)
        ),
    )
    request = PipelineCreate(scene_id=scene_id, model_name=MODEL, fit=FIT, dataset=DATASET, training=TRAINING)
    series("pipeline", lambda: client.pipelines.create(request))


def _rollout(client: Client) -> Job:
    """A rollout of many candidates as a job."""
    still = np.load(SCENE / "scene.npz")["controllers"][0]
    paths = EncodedArray.of(np.broadcast_to(still, (CANDIDATES, TICKS, *still.shape)))
    asked = RolloutCreate(model=MODEL, controllers=paths, start="rest", mode="job")
    answer: Job = client.send(Call("POST", "/v1/rollouts", TypeAdapter(Job), body=asked))
    return answer


def _cold(client: Client, start: Callable[[], Job]) -> Series:
    """Cancel shortly after the start, again and again, each time without a compiled kernel."""
    one = Series(whole_s=float("nan"))
    for wait_s in (1.0, 4.0, 8.0, 12.0):
        _cancelled(client, start, wait_s, one)
    return one


def _series(client: Client, start: Callable[[], Job]) -> tuple[Job, Series]:
    """One job to its end, then ``MOMENTS`` that are cancelled."""
    ended = client.jobs.wait(start(), timeout=JOB_S)
    assert ended.started_at is not None and ended.finished_at is not None
    one = Series((ended.finished_at - ended.started_at).total_seconds())
    for k in range(MOMENTS):
        _cancelled(client, start, one.whole_s * (k + 0.5) / MOMENTS, one)
    return ended, one


def _cancelled(client: Client, start: Callable[[], Job], wait_s: float, one: Series) -> None:
    """Start a job, cancel it after ``wait_s`` of its running, and note how long that takes."""
    asked = time.monotonic()
    job = start()
    while client.jobs.get(job.id).state == "queued":
        time.sleep(LOOK_S)
    one.next_s.append(time.monotonic() - asked)
    time.sleep(wait_s)
    before = client.jobs.get(job.id)
    if before.state in TERMINAL_STATES:
        return
    asked = time.monotonic()
    client.jobs.cancel(job.id)
    while client.jobs.get(job.id).state not in TERMINAL_STATES:
        if time.monotonic() - asked > CANCEL_S:
            break
        time.sleep(LOOK_S)
    one.seconds.append(time.monotonic() - asked)
    one.doing.append(before.progress.message)
    print(f"{before.kind:<11} {wait_s:6.1f} s  {one.seconds[-1]:6.2f} s  {one.doing[-1]}", flush=True)


if __name__ == "__main__":
    run_alone(measure)
