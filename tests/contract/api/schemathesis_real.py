"""What a generator of requests needs of a real service: ids that are there, and things that may be ended.

``Real`` asks the service itself. What a request would delete, cancel, retry or rotate it makes first, so that nothing
else is lost: a job that is cancelled at once leaves an object that nothing is made of. ``Answers`` keeps which
operations were ever answered with success.
"""

from __future__ import annotations

import json
import os
import random
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx

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
            ("POST", "/v1/jobs/{job_id}/cancel"): lambda: self._job(cancelled=False),
            ("POST", "/v1/jobs/{job_id}/retry"): lambda: self._job(cancelled=True),
            ("DELETE", "/v1/models/{name}/aliases/{alias}"): self._alias,
            ("DELETE", "/v1/models/{name}/versions/{version}"): self._version,
            ("DELETE", "/v1/scenes/{scene_id}"): lambda: None,
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

    def listed(self, path: str, key: str = "id") -> list[str]:
        """How paths name what the collection at ``path`` has."""
        at, known = self._listed.get(path, (0.0, []))
        if known and time.monotonic() - at < KNOWN_S:
            return known
        answer = self._client.get(path)
        data = answer.json().get("data", []) if answer.status_code == 200 else []
        known = [str(item[key]) for item in data if key in item]
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

    def digest(self) -> str:
        """Digest of a scene's archive."""
        scene = self._client.get(f"/v1/scenes/{self.one('/v1/scenes')}").json()
        return next((str(item["sha256"]) for item in scene.get("artifacts", [])), "none")

    def archive(self) -> bytes:
        """A recording that the service has: uploaded again it is the same scene."""
        return self._client.get(f"/v1/artifacts/{self.digest()}").content

    def latest(self, model: str) -> int:
        """Number of a model's newest ready version."""
        return int(self._client.get(f"/v1/models/{model}/versions/latest").json().get("version", 1))

    def rollout(self) -> dict[str, Any]:
        """A rollout from rest under still grips, of a model that has so many."""
        model, count, _ = self._model()
        return {"model": model, "start": "rest", "controllers": [[[0.0, 0.0, 0.0]] * count] * TICKS}

    def plan(self) -> dict[str, Any]:
        """A plan that brings the first point somewhere near."""
        model, _, _ = self._model()
        return {"model": model, "goal": {"kind": "points", "points": [0], "positions": [[0.05, 0.0, 0.05]]}}

    def _model(self) -> tuple[str, int, str]:
        """A model, the control points of its scene, and the scene."""
        name = self.one("/v1/models", "name")
        version = self._client.get(f"/v1/models/{name}/versions/latest").json()
        scene = version.get("scene_id") or self.one("/v1/scenes")
        return name, self._client.get(f"/v1/scenes/{scene}").json().get("controllers", 1), scene

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
        name, _, scene = self._model()
        path = f"/v1/models/{name}/versions/latest/assessments"
        return self._object("assessment", {"scene_id": scene, "open_trace": False}, path)

    def _version(self) -> dict[str, str] | None:
        name = f"ended-{uuid4().hex[:8]}"
        body = self.named({"name": name, "dataset_id": ""})
        return None if self._object("model", body) is None else {"name": name, "version": "1"}

    def _alias(self) -> dict[str, str] | None:
        name, _, _ = self._model()
        answer = self._client.put(f"/v1/models/{name}/aliases/ended", json={"version": self.latest(name)})
        return {"name": name, "alias": "ended"} if answer.status_code == 200 else None

    def _key(self) -> dict[str, str] | None:
        made = self._posted("/v1/keys", {"name": "ended", "role": "read"})
        found = made.get("id") or made.get("key", {}).get("id")
        return {"key_id": found} if found else None

    def _job(self, *, cancelled: bool) -> dict[str, str] | None:
        job = self._posted("/v1/checks", self.named({"scene_id": ""}))
        if "id" not in job:
            return None
        if cancelled:
            self._posted(f"/v1/jobs/{job['id']}/cancel", {})
        return {"job_id": job["id"]}


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
            never = [name for name, seen in self._seen.items() if not any(200 <= one < 300 for one in seen)]
            told = {
                "never": sorted(never),
                "answers": {name: dict(seen) for name, seen in self._seen.items()},
            }
            Path(place).write_text(json.dumps(told, indent=1))
