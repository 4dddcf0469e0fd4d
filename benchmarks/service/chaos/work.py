"""The work that goes on under the faults: recordings are uploaded, pipelines asked for and waited for, by the SDK.

Every pipeline has a name of its own, and a recording of its own: a bar held at one end and moved up and down, by a
little more each time. So the ledger can say of each name whether it was done once, twice or never. A pipeline whose
dataset was refused for want of disk is retried, as its user would once there is room again; any other end is left.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from physworld_client import Client
from physworld_client.errors import JobCancelled, JobFailed, PhysWorldError

from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld_scenes.bundle import canonical_archive
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.model import TrainingConfig
from physworld_schemas.pipeline import PipelineCreate

FRAMES, FPS, LENGTH_M, SIDE_M = 12, 30.0, 0.12, 0.03
FIT = FitConfig(particle_budget=60, max_simulations=2, damping="none", numerics=False)
TRAINING = TrainingConfig(
    hidden=16, message_passing_steps=2, history=2, look_ahead=2, vertices=20, steps=60, batch_size=2, patience=0,
    fine_tune_steps=5, formats=[],
)  # fmt: skip
ANSWER_S, WAIT_S, PAUSE_S = 15.0, 30.0, 1.0
REFUSED = "NotEnoughDisk"
RETRY_AFTER_S = 5.0
RETRIES = 1000
"""The client goes on with the same Idempotency-Key until the run ends it."""


def bar(number: int) -> Scene:
    """Recording ``number``: four tracked points follow the grip of a soft bar, 12 frames of 1/30 s."""
    times = np.arange(FRAMES) / FPS
    stroke_m = 0.01 + 1e-6 * number
    lift = stroke_m * np.sin(2 * np.pi * 1.5 * times)[:, None, None] * np.array([0.0, 0.0, 1.0])
    points = np.stack([np.array([0.03, 0.06, 0.09, 0.12]), np.zeros(4), np.full(4, SIDE_M / 2)], axis=1)
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    low, high = np.array([0.0, -SIDE_M / 2, -SIDE_M / 2]), np.array([LENGTH_M, SIDE_M / 2, SIDE_M / 2])
    split = round(0.7 * FRAMES)
    return Scene(
        name=f"bar {number}",
        kind="beam",
        points=points + lift,
        visible=np.ones((FRAMES, 4), dtype=bool),
        controllers=grip + lift,
        times=times,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=1e-3,
        train=(0, split),
        test=(split, FRAMES),
        initial_state=UNDEFORMED_AT_REST,
        fps=FPS,
        body=Body(box_min_m=low, box_max_m=high, density_kg_m3=300.0),
        grips=(
            Grip(
                controllers=(0, 1, 2, 3), region_min_m=low, region_max_m=np.array([0.02, SIDE_M / 2, SIDE_M / 2])
            ),
        ),
    )  # fmt: skip


@dataclass
class Asked:
    """A pipeline that was asked for. ``job_id`` None: no answer came, so nothing was promised."""

    name: str
    job_id: str | None = None
    state: str = "asked"
    asked_again: int = 0
    retried: int = 0


@dataclass
class Work:
    """Threads that keep the service busy.

    Attributes:
        folder: for the files to upload, and the client's list of signing keys.
        url, token: of the service.
        episodes: of each pipeline's dataset.
        asked: every pipeline so far.
    """

    folder: Path
    url: str
    token: str
    episodes: int
    asked: list[Asked] = field(default_factory=list)
    _no_more: threading.Event = field(default_factory=threading.Event)
    _give_up: threading.Event = field(default_factory=threading.Event)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _threads: list[threading.Thread] = field(default_factory=list)

    def start(self, threads: int) -> None:
        """Begin."""
        for number in range(threads):
            thread = threading.Thread(target=self._loop, name=f"work-{number}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def finish(self, seconds: float) -> None:
        """Ask for nothing more, and wait for what was asked for, at most so long."""
        self._no_more.set()
        deadline = time.monotonic() + seconds
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        self._give_up.set()
        for thread in self._threads:
            thread.join(2.0)

    @property
    def busy(self) -> bool:
        """Whether anything is still waited for."""
        return any(thread.is_alive() for thread in self._threads)

    def _loop(self) -> None:
        with Client(
            self.url, self.token, timeout=ANSWER_S, max_retries=RETRIES, known_keys=self.folder / "known-keys.json"
        ) as client:  # fmt: skip
            while not self._no_more.is_set():
                with self._lock:
                    asked = Asked(f"bar-{len(self.asked):04d}")
                    self.asked.append(asked)
                self._one(client, asked)

    def _one(self, client: Client, asked: Asked) -> None:
        """One pipeline from the upload to its end. An error of the service is waited out and asked about again."""
        number = int(asked.name.rpartition("-")[2])
        archive = self.folder / f"{asked.name}.zip"
        archive.write_bytes(canonical_archive(bar(number)))
        job: Job | None = None
        refused = False
        while not self._give_up.is_set():
            again, refused = refused, False
            try:
                if job is not None and again:
                    asked.retried += 1
                    client.jobs.retry(job.id)
                if job is None:
                    scene = client.scenes.create(archive)
                    body = PipelineCreate(
                        scene_id=scene.id,
                        model_name=asked.name,
                        fit=FIT,
                        dataset=DatasetConfig(episodes=self.episodes, frames=24, seed=number),
                        training=TRAINING,
                    )
                    job = client.pipelines.create(body)
                    asked.job_id = job.id
                asked.state = client.jobs.wait(job, timeout=WAIT_S).state
                break
            except (JobFailed, JobCancelled) as error:
                asked.state = error.job.state
                refused = error.job.error is not None and REFUSED in str(error.job.error.detail)
                if not refused:
                    break
                self._give_up.wait(RETRY_AFTER_S)
            except PhysWorldError:  # a full store (507), a stream that broke, a wait that was too short
                asked.asked_again += 1
                self._give_up.wait(PAUSE_S)
        archive.unlink()
