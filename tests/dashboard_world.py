"""An installation to look at: every row and file made through the storage, as workers make them.

One scene went through the whole chain (fit, dataset of three episodes, model), a second one has a fit under
way, a third one's fit has failed. Numbers are synthetic: a damped chain of points, and predictions beside it.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from tiny_scene import register

from physworld.demonstrate.coverage import Coverage
from physworld.scene import Body, Scene
from physworld_schemas.arrays import EncodedArray
from physworld_schemas.assessment import AssessmentCreate
from physworld_schemas.base import Artifact, Problem
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job, Progress
from physworld_schemas.model import TrainingConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceCreate
from physworld_services.stores import Stores
from physworld_storage import resources
from physworld_storage.access import api_keys
from physworld_storage.database import Database, open_database
from physworld_storage.jobs import jobs, leases
from physworld_storage.runs import RunKind
from physworld_storage.settings import Settings
from physworld_storage.traces import TRACKS
from physworld_workers.tasks.dataset_card import store_card

FRAMES, POINTS, PARTICLES = 90, 24, 300
FIRST_HELD_OUT = 63
EPISODES = 3
LEASE_SECONDS = 600.0
PREDICTORS = ("static", "rigid_follow", "constant_velocity", "twin", "world_model", "world_model_finetuned")


@dataclass
class World:
    """Stores, the keys of the people, and the ids of what was made."""

    settings: Settings
    database: Database
    stores: Stores
    writer_token: str = ""
    reader_token: str = ""
    admin_token: str = ""
    rollout_id: str = ""
    plan_id: str = ""
    trace_id: str = ""
    assessment_id: str = ""
    scene_id: str = ""
    pipeline_id: str = ""
    dataset_id: str = ""
    model_file: Artifact | None = None
    model_bytes: bytes = b""
    running: leases.Lease | None = None
    running_id: str = ""
    failed_id: str = ""
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


def build_world(folder: Path) -> World:
    """The installation in ``folder``."""
    settings = Settings(data_dir=folder)
    database = open_database(settings)
    database.upgrade()
    world = World(settings, database, Stores(settings))
    with database.session() as session:
        _, world.writer_token = api_keys.create_key(session, "writer", "write")
        _, world.reader_token = api_keys.create_key(session, "reader", "read")
        _, world.admin_token = api_keys.create_key(session, "admin", "admin")
    recording = chain_recording()
    world.scene_id = add_scene(world, recording)
    world.pipeline_id = _finish_pipeline(world, recording)
    world.failed_id = _fail_fit(world, add_scene(world, replace(recording, name="chain_failed")))
    _start_fit(world, add_scene(world, replace(recording, name="chain_running")))
    _trace(world, recording)
    world.assessment_id = _assess(world)
    world.rollout_id = _run(world, recording, "rollout")
    world.plan_id = _run(world, recording, "plan")
    return world


def chain_recording() -> Scene:
    """A hanging chain that swings and settles; every seventh observation is hidden."""
    times = np.arange(FRAMES) / 30.0
    along = np.linspace(0.0, 1.0, POINTS)
    swing = 0.7 * np.exp(-0.35 * times[:, None]) * np.cos(3.4 * times[:, None] - 0.9 * along)
    points = np.stack(
        [
            0.45 * along * np.sin(swing),
            0.06 * np.sin(5.0 * along + times[:, None]),
            0.6 - 0.45 * along * np.cos(swing),
        ],
        axis=-1,
    )
    hidden = (np.arange(FRAMES)[:, None] + np.arange(POINTS)) % 7 == 3
    hidden[0] = False
    return Scene(
        name="chain_swing",
        kind="rope",
        description="A chain of 24 markers, held at one end, swings and settles.",
        points=points,
        visible=~hidden,
        controllers=np.repeat(points[:, :1], 1, axis=1),
        times=times,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=2e-4,
        train=(0, FIRST_HELD_OUT),
        test=(FIRST_HELD_OUT, FRAMES),
        body=Body(length_m=0.45, radius_m=0.008, density_kg_m3=1100.0),
    )


def add_scene(world: World, recording: Scene) -> str:
    """Store a recording as the API does; its id."""
    declared = {"gravity_m_s2": [0.0, 0.0, -9.81], "body": {"length_m": 0.45, "density_kg_m3": 1100.0}}
    return register(recording, world.database, world.stores.artifacts, declared)


def claim(world: World, job_id: str) -> leases.Lease:
    """Take the next queued shard of a job, as a worker does."""
    with world.database.session() as session:
        family = {job_id, *jobs.get_job(session, job_id).children}
        for publication in leases.publishable(session, 1000):
            lease = leases.claim(session, publication.shard_id, "test", LEASE_SECONDS)
            if lease is not None and lease.job_id in family:
                return lease
            if lease is not None:
                leases.release(session, lease)
    raise AssertionError(f"job {job_id} has no queued shard")


def report(world: World, lease: leases.Lease, done: float, total: float, unit: str, message: str) -> None:
    """Renew a lease with progress."""
    progress = Progress(done=done, total=total, unit=unit, message=message)
    with world.database.session() as session:
        leases.renew(session, lease, LEASE_SECONDS, progress)


def complete(world: World, lease: leases.Lease, result: dict[str, Any], digest: str | None = None) -> None:
    """Commit a shard's result."""
    with world.database.session() as session:
        assert leases.complete(session, lease, result, digest)


def _finish_pipeline(world: World, recording: Scene) -> str:
    request = PipelineCreate(
        scene_id=world.scene_id,
        fit=FitConfig(max_simulations=40),
        dataset=DatasetConfig(episodes=EPISODES),
        training=TrainingConfig(steps=500),
    )
    with world.database.session() as session:
        pipeline = jobs.create_pipeline(session, request)
    lease = claim(world, pipeline.id)
    report(world, lease, 20, 40, "simulations", "Gauss-Newton, loss 2.1e-6")
    complete(world, lease, _fit_result(world, recording))
    complete(world, claim(world, pipeline.id), {"episodes": EPISODES, "frames": 40, "particles": PARTICLES})
    for _ in range(EPISODES):
        lease = claim(world, pipeline.id)
        world.dataset_id = lease.payload["dataset_id"]
        _write_episode(world, lease)
    lease = claim(world, pipeline.id)
    with world.database.reading() as session:
        episodes = resources.all_episodes(session, world.dataset_id)
    manifest = world.stores.episodes.write_manifest(world.dataset_id, episodes)
    files = [manifest, *_card(world, manifest.sha256)]
    seal = {
        "digest": manifest.sha256,
        "statistics": {"seconds": 12.5},
        "artifacts": [artifact.model_dump() for artifact in files],
    }
    complete(world, lease, seal, manifest.sha256)
    complete(world, claim(world, pipeline.id), _training_result(world, recording))
    return pipeline.id


def _card(world: World, digest: str) -> list[Artifact]:
    """The dataset's card with its pictures; one try of the second episode was rejected."""
    coverage = Coverage(EPISODES)
    for line, arrays, _ in world.stores.episodes.iterate(digest):
        refused = {
            "seed": 77,
            "motion": "twist",
            "kind": "UnstableSimulation",
            "reason": "t = 0.31 s: <b>not</b> finite",
        }
        tried = [refused] if line.index == 1 else []
        coverage.add(arrays, {"motion": line.motion, "index": line.index, "rejected": tried})
    return store_card(
        world.stores.artifacts, world.dataset_id, digest, DatasetConfig(episodes=EPISODES), coverage
    )[1]


def _fit_result(world: World, recording: Scene) -> dict[str, Any]:
    generator = np.random.default_rng(0)
    drift = np.linspace(0.0, 0.02, FRAMES)[:, None, None] * np.array([1.0, 0.4, -0.3])
    along = generator.integers(0, POINTS, PARTICLES)
    tracks = (recording.points + drift).astype(np.float32)
    particles = tracks[:, along] + 0.012 * generator.standard_normal((PARTICLES, 3)).astype(np.float32)
    world.arrays = {"tracks": tracks, "particles": particles.astype(np.float32), "times": recording.times}
    prediction = world.stores.artifacts.put_bytes(packed(world.arrays), "prediction.npz")
    parameter = {"value": 1.84e5, "unit": "Pa", "ci95": [1.71e5, 1.98e5], "identified": True}
    density = {"value": 1100.0, "unit": "kg/m³", "identified": False, "note": "declared"}
    return {
        "parameters": {"youngs_modulus": parameter, "density": density},
        "metrics": {"held_out": held_out(recording, PREDICTORS[:4])},
        "artifacts": [prediction.model_dump()],
        "lineage": {"code_version": "0.2.0", "seeds": {"fit": 0}, "device": "cpu"},
    }


def _write_episode(world: World, lease: leases.Lease) -> None:
    times = np.arange(40) / 30.0
    rest = np.random.default_rng(lease.index).uniform(-0.05, 0.05, (PARTICLES, 3))
    path = 0.1 * np.stack([np.sin(times), np.cos(times), 0.2 * times], axis=-1)
    arrays = {
        "times": times,
        "particles": (rest + path[:, None]).astype(np.float32),
        "controllers": path[:, None].astype(np.float32),
        "properties": np.zeros((PARTICLES, 2), np.float32),
    }
    place, digest = world.stores.episodes.write(world.dataset_id, lease.index, lease.epoch, arrays, {})
    result = {
        "index": lease.index,
        "path": place,
        "digest": digest,
        "seed": 1000 + lease.index,
        "frames": len(times),
        "particles": PARTICLES,
        "motion": "bezier",
    }
    complete(world, lease, result, digest)


def _training_result(world: World, recording: Scene) -> dict[str, Any]:
    world.model_bytes = bytes(range(256)) * 300
    put = world.stores.artifacts.put_bytes
    world.model_file = put(world.model_bytes, "model.safetensors")
    tracks = (recording.points + 0.01).astype(np.float32)
    ticks = slice(None, None, 2)  # the network has a clock of its own
    arrays = {"tracks": tracks, "times": recording.times}
    arrays |= {"vertices": tracks[ticks, ::2], "tick_times": recording.times[ticks]}
    manifest = put(json.dumps({"name": "chain_swing", "version": 1}).encode(), "manifest.json")
    files = [world.model_file, manifest, put(packed(arrays), "prediction.npz")]
    return {
        "artifacts": [item.model_dump() for item in files],
        "sha256": manifest.sha256,
        "metrics": {
            "held_out": held_out(recording, PREDICTORS),
            "steps_per_second": {"twin": 41.0, "world_model": 640.0},
            "noise_floor_m": 3.2e-4,
            "seconds": {"training": 91.0},
        },
        "lineage": {"code_version": "0.2.0", "seeds": {"training": 7}, "device": "cpu"},
    }


def held_out(recording: Scene, predictors: tuple[str, ...]) -> dict[str, Any]:
    """A table as the library's ``held_out_table`` gives it, each predictor better than the last."""
    times = recording.times[FIRST_HELD_OUT:]
    errors = {name: 0.03 / (index + 1) for index, name in enumerate(predictors)}
    growth = np.linspace(0.6, 1.4, len(times))
    return {
        "track_m": errors,
        "chamfer_phystwin_m": {name: error / 2 for name, error in errors.items()},
        "chamfer_l2_m": {name: error / 3 for name, error in errors.items()},
        "noise_floor_m": 3.2e-4,
        "frames": [FIRST_HELD_OUT, FRAMES],
        "per_frame": {
            "frames": list(range(FIRST_HELD_OUT, FRAMES)),
            "times_s": times.tolist(),
            "track_m": {name: (error * growth).tolist() for name, error in errors.items()},
        },
    }


def _trace(world: World, recording: Scene) -> None:
    """A trace that named an effect, with its tracks and candidates."""
    with world.database.session() as session:
        job = jobs.create_trace(session, TraceCreate(scene_id=world.scene_id))
    world.trace_id = job.outputs[0].id
    tracks = {"times": recording.times, "before": recording.points + 0.01, "after": recording.points + 0.002}
    stored = world.stores.artifacts.put_bytes(packed(tracks), TRACKS)
    effect = {"name": "drag", "parameters": {"rate": {"value": 0.8, "unit": "1/s", "ci95": [0.7, 0.9]}}}
    report = {
        "scene": recording.name,
        "reason": "Drag accounts for what the twin leaves",
        "effects": [effect],
        "candidates": [{"name": "drag", "score": 0.6, "threshold": 0.05, "selected": True}],
        "held_out": {"before": 0.01, "after": 0.002, "after_ci95": [0.001, 0.003], "noise_floor": 3.2e-4},
        "path": [{"base": [], "kept": ["drag"], "tried": [{"effects": ["drag"], "misfit": 1.02}]}],
    }
    complete(
        world,
        claim(world, job.id),
        {"verdict": "named", "report": report, "artifacts": [stored.model_dump()]},
    )


def _assess(world: World) -> str:
    """An assessment that found the model worse than it promised."""
    with world.database.session() as session:
        asked = AssessmentCreate(scene_id=world.scene_id, open_trace=False)
        job = jobs.create_assessment(session, "chain_swing", 1, asked)
    measured = {"error_m": 0.006, "ci95_m": [0.005, 0.007], "noise_floor_m": 3.2e-4, "frames": 27}
    answer = {
        "outcome": "worse_than_expected", "reason": "It errs by more than was promised", "measured": measured,
        "expected": {**measured, "error_m": 0.004, "ci95_m": [0.003, 0.005]}, "excess_m": 0.002,
        "excess_ci95_m": [0.001, 0.003], "start_mismatch_m": 0.0, "twin_m": 0.005,
        "baselines_m": {"static": 0.03, "rigid_follow": 0.02, "constant_velocity": 0.01},
    }  # fmt: skip
    complete(world, claim(world, job.id), answer)
    return str(job.outputs[0].id)


def _run(world: World, recording: Scene, kind: RunKind) -> str:
    """A rollout or a plan that is ready, with its arrays."""
    put = world.stores.artifacts.put_bytes
    asked = {"controllers": EncodedArray.of(recording.controllers[:60]).model_dump()}
    request = put(json.dumps(asked).encode(), "request.json", "application/json")
    with world.database.session() as session:
        job = jobs.create_run(session, kind, "chain_swing", 1, {}, request, 10)
    points = recording.points[:60].astype(np.float32)
    arrays: dict[str, np.ndarray] = {"times": recording.times[:60], "points": points[None]}
    if kind == "plan":
        arrays = {"times": recording.times[:60], "controllers": recording.controllers[:64]}
        arrays |= {"predicted": points, "executed": points + 0.003, "goal_places": points[-1]}
    result = put(packed(arrays), f"{kind}.npz")
    figures = {
        "seconds": 1.5,
        "ticks": 60,
        "candidates": 1,
        "predicted_error_m": 0.002,
        "executed_error_m": 0.004,
    }
    complete(world, claim(world, job.id), {"figures": figures, "artifacts": [result.model_dump()]})
    return str(job.outputs[0].id)


def _fail_fit(world: World, scene_id: str) -> str:
    job = _open_fit(world, scene_id)
    lease = claim(world, job.id)
    problem = Problem(
        title="The time step is too long",
        status=422,
        code="cfl_violation",
        detail="dt 1.0e-4 s exceeds the CFL limit 6.1e-5 s for E 2.0e6 Pa at dx 0.01 m",
        hint="Lower the particle budget, or let the engine choose the step.",
    )
    with world.database.session() as session:
        leases.fail(session, lease, problem, retry=False)
    return job.id


def _start_fit(world: World, scene_id: str) -> None:
    world.running_id = _open_fit(world, scene_id).id
    world.running = claim(world, world.running_id)
    report(world, world.running, 10, 80, "simulations", "global stage")


def _open_fit(world: World, scene_id: str) -> Job:
    with world.database.session() as session:
        return jobs.create_fit(session, scene_id, FitConfig())


def packed(arrays: dict[str, np.ndarray]) -> bytes:
    """Arrays as the bytes of an npz."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()
