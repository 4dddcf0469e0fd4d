"""The real web application on a free loopback port, small recordings, and a hand that does the work."""

from __future__ import annotations

import asyncio
import hashlib
import io
import json
import zipfile
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np
from checked import REPORT as CHECKED
from fastapi import FastAPI

from physworld_services.stores import Stores
from physworld_storage.access.api_keys import Role, create_key
from physworld_storage.database import Database
from physworld_storage.jobs import leases
from physworld_storage.jobs.leases import Lease
from physworld_storage.settings import Settings

LEASE_S = 30.0
FRAMES, POINTS = 20, 9
REPORT: dict[str, Any] = {
    "schema_version": 1,
    "scene": "strip",
    "reason": "best supported among 20 candidates: air_drag_linear",
    "effects": [
        {
            "name": "air_drag_linear",
            "parameters": {"rate_per_s": {"value": 1.9, "ci95": [1.6, 2.2], "unit": "1/s"}},
        }
    ],
    "equivalent": [],
    "candidates": [{"name": "air_drag_linear", "score": 0.4, "threshold": 0.02, "selected": True}],
    "held_out": {"metric": "track_rmse_m", "noise_floor": 1e-4, "before": 2e-3, "after": 3e-4},
    "calibrated": {"youngs_modulus_pa": {"value": 1e5, "ci95": [9e4, 1.1e5], "unit": "Pa"}},
    "unexplained": {"rms_m": 1e-4, "description": "nothing above the noise"},
    "suggested_experiment": None,
    "seconds": 1.5,
    "simulations": 40,
    "hypotheses": [{"effects": ["air_drag_linear"], "posterior": 0.97}],
}
TRACKS = {
    "times": np.arange(3) / 30.0,
    "before": np.zeros((3, 2, 3)),
    "after": np.ones((3, 2, 3)),
}
EPISODE = {
    "times": np.arange(4) / 30.0,
    "particles": np.arange(4 * 5 * 3, dtype=np.float32).reshape(4, 5, 3),
    "controllers": np.zeros((4, 1, 3), np.float32),
    "properties": np.zeros((5, 2), np.float32),
}


@dataclass
class Service:
    """A running service: its address, a token for each role, and what lies behind it."""

    url: str
    settings: Settings
    database: Database
    stores: Stores
    tokens: dict[str, str] = field(default_factory=dict)
    verdict: str = "named"
    outcome: str = "as_expected"

    def client(self, role: Role | None = "admin") -> httpx.Client:
        """A client with a key of this role, or without any."""
        headers = {"Authorization": f"Bearer {self.token(role)}"} if role else {}
        return httpx.Client(base_url=self.url, headers=headers, timeout=30.0, trust_env=False)

    def token(self, role: Role) -> str:
        """A key's token for this role, the same each time."""
        if role not in self.tokens:
            with self.database.session() as session:
                self.tokens[role] = create_key(session, f"test {role}", role)[1]
        return self.tokens[role]

    def work(self, shards: int | None = None) -> int:
        """Execute queued shards until none is left, or so many; how many were executed."""
        done = 0
        while shards is None or done < shards:
            lease = self.claim()
            if lease is None:
                break
            result, digest = self._result(lease)
            with self.database.session() as session:
                assert leases.complete(session, lease, result, digest)
            done += 1
        return done

    def claim(self) -> Lease | None:
        """Take the next queued shard, or None."""
        with self.database.session() as session:
            ready = leases.publishable(session)
            leases.mark_published(session, ready[:1])
            return leases.claim(session, ready[0].shard_id, "test", LEASE_S) if ready else None

    def _result(self, lease: Lease) -> tuple[dict[str, Any], str | None]:
        put = self.stores.artifacts.put_bytes
        payload = lease.payload
        if lease.kind == "fit":
            parameter = {"value": 2.0e5, "unit": "Pa", "ci95": [1.8e5, 2.2e5]}
            artifacts = [put(lease.shard_id.encode(), "twin.npz").model_dump()]
            return {"parameters": {"E": parameter}, "metrics": {}, "artifacts": artifacts}, None
        if lease.kind == "trace":
            report = {**REPORT, "verdict": self.verdict}
            tracks = io.BytesIO()
            np.savez(tracks, allow_pickle=False, **TRACKS)
            files = {"report.json": json.dumps(report).encode(), "tracks.npz": tracks.getvalue()}
            if self.verdict == "named":
                files["twin.npz"] = lease.shard_id.encode()
            artifacts = [put(content, name).model_dump() for name, content in files.items()]
            return {"verdict": self.verdict, "report": report, "artifacts": artifacts}, None
        if lease.kind == "check":
            return {"report": CHECKED}, None
        if lease.kind == "assessment":
            figure = {"error_m": 2e-3, "ci95_m": [1e-3, 3e-3], "noise_floor_m": 1e-4, "frames": 10}
            excess: dict[str, Any] = {
                "excess_m": 0.0,
                "excess_ci95_m": [-1e-6, 1e-6],
                "start_mismatch_m": 0.0,
            }
            other = payload["compared"]
            if other is not None:
                worse = {"version": other["version"], "measured": {**figure, "error_m": 5e-3}, "twin_m": 4e-3}
                excess["compared"] = {**worse, "gain_m": 3e-3, "gain_ci95_m": [2e-3, 4e-3]}
            named = {"outcome": self.outcome, "reason": "it is so", "measured": figure, "expected": figure}
            return {**named, **excess}, None
        if lease.kind == "dataset_plan":
            return {"episodes": payload["config"]["episodes"], "frames": 4, "particles": 5}, None
        if lease.kind == "episode":
            path, digest = self.stores.episodes.write(
                payload["dataset_id"], lease.index, lease.epoch, EPISODE, {"motion": "bezier"}
            )
            place = {"index": lease.index, "path": path, "digest": digest, "seed": lease.index}
            return {**place, "frames": 4, "particles": 5, "motion": "bezier"}, digest
        manifest = put(lease.shard_id.encode(), "manifest.json")
        artifacts = [manifest.model_dump()]
        if lease.kind == "dataset_seal":
            return {"digest": manifest.sha256, "artifacts": artifacts}, manifest.sha256
        return {"sha256": manifest.sha256, "artifacts": artifacts, "metrics": {}}, manifest.sha256


def bundle(
    name: str = "strip", *, seed: int = 0, arrays: dict[str, Any] | None = None, **declared: Any
) -> bytes:
    """A zip of a small recording: 9 points on a strip of 0.2 m that follow one controller for 20 frames."""
    times = np.arange(FRAMES) / 30.0
    rest = np.stack([np.linspace(0.0, 0.2, POINTS), np.zeros(POINTS), np.full(POINTS, 0.5)], axis=1)
    shift = np.stack([0.05 * np.sin(4.0 * times), np.zeros(FRAMES), np.zeros(FRAMES)], axis=1)
    noise = np.random.default_rng(seed).normal(0.0, 1e-4, (FRAMES, POINTS, 3))
    measured: dict[str, Any] = {
        "points": (rest + shift[:, None] + noise).astype(np.float32),
        "visible": np.ones((FRAMES, POINTS), dtype=bool),
        "controllers": (rest[:1] + shift[:, None]).astype(np.float32),
        "times": times,
    }
    text: dict[str, Any] = {
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
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, **(measured | (arrays or {})))
    return archive({"scene.json": json.dumps(text | declared).encode(), "scene.npz": buffer.getvalue()})


def archive(members: dict[str, bytes]) -> bytes:
    """A zip of these members."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name, content in members.items():
            file.writestr(zipfile.ZipInfo(name), content)  # without the time of day
    return buffer.getvalue()


def upload(client: httpx.Client, data: bytes, filename: str = "scene.zip", **fields: str) -> httpx.Response:
    """POST /v1/scenes."""
    return client.post("/v1/scenes", files={"bundle": (filename, data)}, data=fields)


def scene_id(client: httpx.Client, name: str = "strip") -> str:
    """The id of an uploaded recording."""
    return str(upload(client, bundle(name)).json()["id"])


def sha256(data: bytes) -> str:
    """Hex SHA-256."""
    return hashlib.sha256(data).hexdigest()


def ask(app: FastAPI, path: str, headers: dict[str, str] | None = None) -> httpx.Response:
    """GET, without a server in between."""

    async def get() -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://test") as client:
            return await client.get(path, headers=headers)

    return asyncio.run(get())


def assert_problem(response: httpx.Response, status: int, code: str) -> dict[str, Any]:
    """The answer is this problem, in the form that every problem has."""
    assert response.status_code == status, response.text
    assert response.headers["Content-Type"] == "application/problem+json"
    problem: dict[str, Any] = response.json()
    assert problem["status"] == status
    assert problem["code"] == code
    assert problem["type"] == f"urn:physworld:problem:{code}"
    assert problem["title"]
    assert problem["request_id"] == response.headers["X-Request-Id"]
    return problem
