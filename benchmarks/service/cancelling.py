"""How long a job of each kind takes to be cancelled: from POST cancel to the state ``cancelled``.

The sample scene through the real embedded service with two workers and the trainer. A job of every kind is started
again and again and cancelled some seconds after it began, at moments that meet it in what it does for long; a fit, a
dataset and a training are first run to their ends, for the kinds that need them. The first fits run on an empty cache
of kernels, so that they are cancelled while those are compiled.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from physworld_client import Client
from physworld_client.calls import Call

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
MOMENTS_S, LATE_MOMENTS_S = (1.0, 6.0, 15.0, 30.0), (5.0, 20.0, 45.0, 80.0)
CANDIDATES, TICKS = 64, 300
LOOK_S = 0.05
JOB_S, CANCEL_S = 1800.0, 300.0
MODEL = "cancelled"
FIT = FitConfig(max_simulations=8, particle_budget=800)
DATASET = DatasetConfig(episodes=6, frames=60)
TRAINING = TrainingConfig(steps=6, fine_tune_steps=3, hidden=16, vertices=50, formats=["torch_export"])
TRACE = TraceConfig(candidates=["air_drag_linear", "viscosity_kelvin_voigt"], confirmed=2, iterations=2)
TRACED = FitConfig(max_simulations=12, particle_budget=600, damping="none")


@dataclass
class Series:
    """Cancellations of one kind.

    Attributes:
        seconds: from POST cancel to the state ``cancelled``, one a moment [s].
        doing: what the job told when it was cancelled, one a moment.
        next_s: from the POST of the next job to its start [s].
    """

    seconds: list[float] = field(default_factory=list)
    doing: list[str] = field(default_factory=list)
    next_s: list[float] = field(default_factory=list)


def measure(repeats: int, seed: int) -> Report:
    """Cancel every kind at each moment; ``repeats`` is of no use here: a moment is met once."""
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

            found["fit, no kernel compiled yet"] = _series(client, fit)
        with service(data, 2, trainer=True) as client:
            _all_kinds(client, scene.id, found)
    found = {name: one for name, one in found.items() if one.seconds}
    worst = max(max(one.seconds) for one in found.values())
    rows = [
        [
            name,
            str(len(one.seconds)),
            f"{summarise(one.seconds).median:.1f}",
            f"{max(one.seconds):.1f}",
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
            "cancelled",
            "median [s]",
            "longest [s]",
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

    def made(name: str, start: Callable[[], Job], moments: Sequence[float] = MOMENTS_S) -> str:
        ended = client.jobs.wait(start(), timeout=JOB_S)
        found[name] = _series(client, start, moments)
        return str(ended.outputs[0].id)

    fit_id = made("fit", lambda: client.fits.create(scene_id, FIT))
    found["trace"] = _series(client, lambda: client.traces.create(scene_id, TRACE, fit=TRACED))
    dataset_id = made("dataset", lambda: client.datasets.create(fit_id, DATASET))
    made("training", lambda: client.models.create(MODEL, dataset_id, TRAINING), LATE_MOMENTS_S)
    found["assessment"] = _series(
        client, lambda: client.assessments.create(MODEL, scene_id, 1, open_trace=False)
    )
    found["rollout"] = _series(client, lambda: _rollout(client))
    goal = PlanConfig(horizon=60, samples=512, iterations=10)
    found["plan"] = _series(
        client, lambda: client.plans.create(MODEL, 1, points={0: [0.0, 0.0, 0.0]}, config=goal)
    )
    request = PipelineCreate(scene_id=scene_id, model_name=MODEL, fit=FIT, dataset=DATASET, training=TRAINING)
    found["pipeline"] = _series(client, lambda: client.pipelines.create(request), LATE_MOMENTS_S)


def _rollout(client: Client) -> Job:
    """A rollout of many candidates as a job."""
    still = np.load(SCENE / "scene.npz")["controllers"][0]
    paths = EncodedArray.of(np.broadcast_to(still, (CANDIDATES, TICKS, *still.shape)))
    asked = RolloutCreate(model=MODEL, version=1, controllers=paths, start="rest", mode="job")
    answer: Job = client.send(Call("POST", "/v1/rollouts", Job, body=asked))
    return answer


def _series(client: Client, start: Callable[[], Job], moments: Sequence[float] = MOMENTS_S) -> Series:
    """Jobs that are cancelled so many seconds after they began."""
    one = Series()
    for wait_s in moments:
        _cancelled(client, start, wait_s, one)
    return one


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
