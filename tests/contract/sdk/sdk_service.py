"""The real web application on a free loopback port, and a hand that does the workers' part.

``Service.work`` takes shards through the same leases as a worker and commits results of a believable form, so
that the SDK sees every state of a job without simulations.
"""

from __future__ import annotations

import base64
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from checked import REPORT as CHECKED
from physworld_client import Client

from physworld_schemas.base import Artifact, Problem
from physworld_services.stores import Stores
from physworld_storage import signing
from physworld_storage.database import Database
from physworld_storage.jobs import leases

LEASE_S = 30.0
METRICS = ("track_m", "chamfer_phystwin_m", "chamfer_l2_m")
ROWS = ("static", "rigid_follow", "constant_velocity", "twin", "world_model", "world_model_finetuned")


@dataclass
class Service:
    """A running service: its address, an admin key, and what lies behind it."""

    url: str
    token: str
    database: Database
    stores: Stores

    def client(self, **options: Any) -> Client:
        """A client with the admin key."""
        return Client(self.url, self.token, **options)

    def work(self, shards: int | None = None) -> int:
        """Executes queued shards until none is left, or so many; returns how many."""
        done = 0
        while shards is None or done < shards:
            lease = self.claim()
            if lease is None:
                break
            result = self._result(lease)
            with self.database.session() as session:
                assert leases.complete(session, lease, result)
            done += 1
        return done

    def claim(self) -> leases.Lease | None:
        """Takes the next queued shard, or None."""
        with self.database.session() as session:
            ready = leases.publishable(session)
            leases.mark_published(session, ready[:1])
            return leases.claim(session, ready[0].shard_id, "test", LEASE_S) if ready else None

    def fail(self, problem: Problem) -> None:
        """The next queued shard fails for good."""
        lease = self.claim()
        assert lease is not None
        self.fail_lease(lease, problem)

    def fail_lease(self, lease: leases.Lease, problem: Problem) -> None:
        """This shard fails for good."""
        with self.database.session() as session:
            leases.fail(session, lease, problem, retry=False)

    def _put(self, name: str, data: bytes) -> Artifact:
        return self.stores.artifacts.put_bytes(data, name)

    def _result(self, lease: leases.Lease) -> dict[str, Any]:
        if lease.kind == "fit":
            twin = self._put("twin.npz", np.random.default_rng(0).bytes(3_000_000))
            parameter = {"value": 2.0e5, "unit": "Pa", "ci95": [1.8e5, 2.2e5]}
            return {
                "parameters": {"youngs_modulus_pa": parameter},
                "metrics": {},
                "artifacts": [twin.model_dump()],
            }
        if lease.kind == "trace":
            return self._traced()
        if lease.kind == "check":
            return {"report": CHECKED}
        if lease.kind == "assessment":
            figure = {"error_m": 0.009, "ci95_m": [0.008, 0.01], "noise_floor_m": 0.0005, "frames": 10}
            promised = {**figure, "error_m": 0.001, "ci95_m": [0.0009, 0.0012]}
            other = lease.payload["compared"]
            return {
                "compared": None if other is None else compared_with(other["version"]),
                "outcome": "worse_than_expected",
                "reason": "The model errs more than noise and its card allow",
                "measured": figure,
                "expected": promised,
                "excess_m": 0.008,
                "excess_ci95_m": [0.006, 0.009],
                "baselines_m": {"static": 0.05},
                "twin_m": 0.008,
                "start_mismatch_m": 0.0,
            }
        if lease.kind == "dataset_plan":
            return {"episodes": lease.payload["config"]["episodes"], "frames": 10, "particles": 20}
        if lease.kind == "episode":
            arrays = {
                "times": np.arange(10) / 30.0,
                "particles": np.full((10, 20, 3), lease.index, np.float32),
                "controllers": np.zeros((10, 2, 3), np.float32),
                "properties": np.zeros((20, 2), np.float32),
            }
            dataset = lease.payload["dataset_id"]
            path, digest = self.stores.episodes.write(
                dataset, lease.index, lease.epoch, arrays, {"motion": "made"}
            )
            place = {"index": lease.index, "path": path, "digest": digest}
            return {**place, "seed": lease.index, "frames": 10, "particles": 20, "motion": "bezier"}
        if lease.kind == "dataset_seal":
            manifest = self._put("manifest.json", lease.shard_id.encode())
            return {"digest": manifest.sha256, "artifacts": [manifest.model_dump()]}
        return self._published(lease.payload["name"], lease.payload["version"])

    def _traced(self) -> dict[str, Any]:
        number = {"value": 1.9, "ci95": [1.6, 2.2], "unit": "1/s"}
        report = {
            "scene": "strip",
            "verdict": "named",
            "reason": "best supported among 20 candidates: air_drag_linear",
            "effects": [{"name": "air_drag_linear", "parameters": {"rate_per_s": number}}],
            "held_out": {"before": 0.021, "after": 0.006, "noise_floor": 0.001},
            "unexplained": {"rms_m": 0.004, "description": "little, at the free end"},
            "simulations": 57,
            "seconds": 12.0,
        }
        tracks = io.BytesIO()
        np.savez(tracks, allow_pickle=False, times=np.arange(3.0), before=np.zeros((3, 2, 3)))
        files = [
            self._put("report.json", json.dumps(report).encode()),
            self._put("tracks.npz", tracks.getvalue()),
            self._put("twin.npz", b"twin"),
        ]
        return {"verdict": "named", "report": report, "artifacts": [file.model_dump() for file in files]}

    def _published(self, name: str, version: int) -> dict[str, Any]:
        files = [self._put("model.safetensors", f"{name} {version}".encode()), self._put("card.json", b"{}")]
        listed = {file.name: {"sha256": file.sha256, "size": file.size} for file in files}
        manifest = {"name": name, "version": version, "files": listed}
        text = json.dumps(manifest).encode()
        files.append(self._put("manifest.json", text))
        signer = signing.signer_of(base64.b64encode(bytes(range(32))).decode(), "the test")
        with self.database.session() as session:
            signing.register(session, signer)
        files.append(self._put("manifest.sig.json", signer.sign(text)))
        held_out: dict[str, Any] = {metric: dict.fromkeys(ROWS, 0.001) for metric in METRICS}
        metrics = {
            "held_out": held_out,
            "steps_per_second": {"twin": 12.0, "world_model": 345.6},
            "noise_floor_m": 0.0005,
        }
        artifacts = [file.model_dump() for file in files]
        return {"artifacts": artifacts, "sha256": files[-2].sha256, "metrics": metrics}


def write_scene(folder: Path, name: str = "strip", *, seed: int = 0) -> Path:
    """A small valid bundle: 9 points on a strip of 0.2 m that follows one controller for 20 frames."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    frames = 20
    times = np.arange(frames) / 30.0
    rest = np.stack([np.linspace(0.0, 0.2, 9), np.zeros(9), np.full(9, 0.5)], axis=1)
    shift = np.stack([0.05 * np.sin(4.0 * times), np.zeros(frames), np.zeros(frames)], axis=1)
    points = rest + shift[:, None] + rng.normal(0.0, 1e-4, (frames, 9, 3))
    np.savez(
        folder / "scene.npz",
        points=points.astype(np.float32),
        visible=np.ones((frames, 9), dtype=bool),
        controllers=(rest[:1] + shift[:, None]).astype(np.float32),
        times=times,
    )
    declared = {
        "schema_version": 1,
        "name": name,
        "kind": "beam",
        "description": "a strip",
        "fps": 30.0,
        "gravity_m_s2": [0.0, 0.0, -9.81],
        "noise_sigma_m": 1e-4,
        "split": {"train": [0, 14], "test": [14, 20]},
        "initial_state": "as measured",
        "body": {"size_m": [0.2, 0.02, 0.02], "density_kg_m3": 1000.0},
        "ground": None,
        "grips": None,
    }
    (folder / "scene.json").write_text(json.dumps(declared))
    return folder


def compared_with(version: int) -> dict[str, Any]:
    """Another version in an assessment: it errs 30 mm, 21 mm more than the assessed one."""
    figure = {"error_m": 0.03, "ci95_m": [0.02, 0.04], "noise_floor_m": 0.0005, "frames": 10}
    return {
        "version": version,
        "measured": figure,
        "twin_m": 0.02,
        "gain_m": 0.021,
        "gain_ci95_m": [0.01, 0.03],
    }
