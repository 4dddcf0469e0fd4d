"""What a generator of requests needs of a real service: ids that are there, and things that may be ended.

``Real`` asks the service itself. What a request would delete, cancel, retry or rotate it makes first, so that nothing
else is lost: a job that is cancelled at once leaves an object that nothing is made of. ``Answers`` keeps which
operations were ever answered with success.
"""

from __future__ import annotations

import io
import json
import os
import random
import time
import zipfile
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import numpy as np

KNOWN_S = 20.0
"""How long a listing is remembered."""
BODY_IDS = {
    "scene_id": ("/v1/scenes", "id"),
    "fit_id": ("/v1/fits?state=ready", "id"),
    "dataset_id": ("/v1/datasets?state=sealed", "id"),
    "model": ("/v1/models", "name"),
}
"""Keys of bodies that name what is there, and the listing that has it."""
UNNAMED = ("trace_id", "scene_ids", "held_out_scene_ids", "assessment_id", "compared_with", "fit_ids")
"""Keys that have to fit what else a body names; a request without them is right as well."""
TICKS = 8
NOT_ALLOWED = 405
"""All that a method answers which a path does not have; it is no operation."""
ENDED = "ended-"
"""How the names begin of what is made here to be deleted."""


class Real:
    """A service with its key."""

    def __init__(self, base: str, token: str) -> None:
        headers = {"Authorization": f"Bearer {token}"}
        self._client = httpx.Client(base_url=base, headers=headers, timeout=60.0, trust_env=False)
        self._listed: dict[str, tuple[float, list[str]]] = {}
        self._random = random.Random(0)
        self.ends: dict[tuple[str, str], Callable[[], dict[str, str] | None]] = {
            ("DELETE", "/v1/keys/{key_id}"): self._key,
            ("POST", "/v1/keys/{key_id}/rotate"): self._key,
            ("POST", "/v1/jobs/{job_id}/cancel"): self._job,
            ("POST", "/v1/jobs/{job_id}/retry"): lambda: {"job_id": self.one("/v1/jobs?state=failed")},
            ("DELETE", "/v1/models/{name}/aliases/{alias}"): self._alias,
            ("DELETE", "/v1/models/{name}/versions/{version}"): self._version,
            ("DELETE", "/v1/scenes/{scene_id}"): lambda: {"scene_id": self.uploaded()},
        }
        for kind, body in {
            "fit": lambda: self.named({"scene_id": ""}),
            "check": lambda: self.named({"scene_id": ""}),
            "trace": lambda: self.named({"scene_id": ""}),
            "dataset": lambda: self.named({"fit_id": ""}),
            "video": lambda: {"of": "scene", "id": self.one("/v1/scenes")},
            "rollout": lambda: self.rollout() | {"mode": "job"},
            "plan": self.plan,
        }.items():
            self.ends["DELETE", f"/v1/{kind}s/{{{kind}_id}}"] = lambda kind=kind, body=body: self._object(
                kind, body()
            )
        self.ends["DELETE", "/v1/assessments/{assessment_id}"] = self._assessment

    def close(self) -> None:
        """Give its connections back."""
        self._client.close()

    def listed(self, path: str, key: str = "id") -> list[str]:
        """How paths name what the collection at ``path`` has."""
        at, known = self._listed.get(path, (0.0, []))
        if known and time.monotonic() - at < KNOWN_S:
            return known
        answer = self._client.get(path)
        data = answer.json().get("data", []) if answer.status_code == 200 else []
        known = [str(item[key]) for item in data if not str(item.get(key, ENDED)).startswith(ENDED)]
        self._listed[path] = (time.monotonic(), known)
        return known

    def one(self, path: str, key: str = "id") -> str:
        """One of them, or a made-up one where there is none."""
        return self._random.choice(self.listed(path, key) or ["none"])

    def named(self, body: dict[str, Any]) -> dict[str, Any]:
        """The body with real ids in the place of its own, and without what would have to fit them."""
        real = {name: value for name, value in body.items() if name not in UNNAMED}
        for name, (path, key) in BODY_IDS.items():
            if name in real:
                real[name] = self.one(path, key)
        if "model" in real and "version" in real:
            real["version"] = "latest"
        return real

    def digest(self, scene: str | None = None) -> str:
        """Digest of a scene's archive."""
        told = self._client.get(f"/v1/scenes/{scene or self.one('/v1/scenes')}").json()
        return next((str(item["sha256"]) for item in told.get("artifacts", [])), "none")

    def archive(self, scene: str | None = None) -> bytes:
        """A recording that the service has: uploaded again it is the same scene."""
        return self._client.get(f"/v1/artifacts/{self.digest(scene)}").content

    def latest(self, model: str) -> int:
        """Number of a model's newest ready version."""
        return int(self._client.get(f"/v1/models/{model}/versions/latest").json().get("version", 1))

    def rollout(self) -> dict[str, Any]:
        """A rollout from rest under grips that stay where the recording begins."""
        model, scene = self._model()
        with zipfile.ZipFile(io.BytesIO(self.archive(scene))) as archive:
            arrays = np.load(
                io.BytesIO(archive.read(next(n for n in archive.namelist() if n.endswith(".npz"))))
            )
        return {"model": model, "start": "rest", "controllers": [arrays["controllers"][0].tolist()] * TICKS}

    def plan(self) -> dict[str, Any]:
        """A plan that brings the first point somewhere near."""
        goal = {"kind": "points", "index": [0], "places": [[0.05, 0.0, 0.05]]}
        return {"model": self._model()[0], "goal": goal}

    def loop(self) -> dict[str, Any]:
        """A loop of a model and another recording of its object."""
        model, scene = self._model()
        return {"model": model, "scene_id": self.uploaded(scene)}

    def looped(self) -> str:
        """Id of a loop, which is its job's: one of those that are there, or a new one that is cancelled at once."""
        if self.listed("/v1/loops"):
            return self.one("/v1/loops")
        job = self._posted("/v1/loops", self.loop())
        self._posted(f"/v1/jobs/{job.get('id')}/cancel", {})
        return str(job.get("id", "none"))

    def compared(self) -> tuple[str, dict[str, str]]:
        """A model and two of its ready versions; where it has one, that twice."""
        name, _ = self._model()
        ready = self.listed(f"/v1/models/{name}/versions?state=ready", "version") or ["latest"]
        return name, {one: self._random.choice(ready) for one in "ab"}

    def uploaded(self, scene: str | None = None) -> str:
        """A new scene: a known recording under another name."""
        files = {"bundle": ("scene.zip", self.archive(scene), "application/zip")}
        made = self._client.post("/v1/scenes", files=files, data={"name": f"{ENDED}{uuid4().hex[:8]}"})
        return str(made.json().get("id", "none"))

    def _model(self) -> tuple[str, str]:
        """A model with a ready version, and the scene that it was made of."""
        models = self._client.get("/v1/models?limit=100").json().get("data", [])
        name = self._random.choice([str(one["name"]) for one in models if one["latest"]] or ["none"])
        version = self._client.get(f"/v1/models/{name}/versions/latest").json()
        return name, version.get("scene_id") or self.one("/v1/scenes")

    def _posted(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        answer = self._client.post(path, json=body, headers={"Idempotency-Key": uuid4().hex})
        return answer.json() if answer.status_code < 300 else {}

    def _object(self, kind: str, body: dict[str, Any], path: str | None = None) -> dict[str, str] | None:
        job = self._posted(path or f"/v1/{kind}s", body)
        if "id" not in job:
            return None
        self._posted(f"/v1/jobs/{job['id']}/cancel", {})
        return next(
            ({f"{kind}_id": made["id"]} for made in job.get("outputs", []) if made["kind"] == kind), None
        )

    def _assessment(self) -> dict[str, str] | None:
        name, scene = self._model()
        path = f"/v1/models/{name}/versions/latest/assessments"
        return self._object("assessment", {"scene_id": scene, "open_trace": False}, path)

    def _version(self) -> dict[str, str] | None:
        name = f"{ENDED}{uuid4().hex[:8]}"
        body = self.named({"name": name, "dataset_id": ""})
        return None if self._object("model", body) is None else {"name": name, "version": "1"}

    def _alias(self) -> dict[str, str] | None:
        name, _ = self._model()
        answer = self._client.put(f"/v1/models/{name}/aliases/ended", json={"version": self.latest(name)})
        return {"name": name, "alias": "ended"} if answer.status_code == 200 else None

    def _key(self) -> dict[str, str] | None:
        made = self._posted("/v1/keys", {"name": "ended", "role": "read"})
        found = made.get("id") or made.get("key", {}).get("id")
        return {"key_id": found} if found else None

    def _job(self) -> dict[str, str] | None:
        job = self._posted("/v1/checks", self.named({"scene_id": ""}))
        return {"job_id": job["id"]} if "id" in job else None


class Answers:
    """Statuses of every operation; written as JSON where the variable names a file."""

    variable = "PHYSWORLD_ANSWERS"

    def __init__(self) -> None:
        self._seen: dict[str, Counter[int]] = defaultdict(Counter)

    def add(self, operation: str, status: int) -> None:
        """One answer."""
        self._seen[operation][status] += 1

    def write(self) -> None:
        """All of them, and the operations that never succeeded."""
        place = os.environ.get(self.variable)
        if place:
            there = {name: seen for name, seen in self._seen.items() if set(seen) != {NOT_ALLOWED}}
            never = [name for name, seen in there.items() if not any(200 <= one < 300 for one in seen)]
            told = {
                "never": sorted(never),
                "answers": {name: dict(seen) for name, seen in there.items()},
            }
            Path(place).write_text(json.dumps(told, indent=1))
