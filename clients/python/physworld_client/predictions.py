"""What rollouts and plans are as arrays, and the calls that ask for them; shared by both clients."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from physworld_client.arrays import arrays_of
from physworld_client.calls import BYTES, Call, _given, _part, artifact_path
from physworld_client.errors import DigestMismatch, ModelUnreadable
from physworld_client.types import Array, Job, Plan, Rollout
from physworld_schemas.arrays import EncodedArray
from physworld_schemas.base import Artifact, Page
from physworld_schemas.plan import PlanConfig, PlanCreate, PlanLimits, PointGoal, ShapeGoal
from physworld_schemas.rollout import Part, RolloutCreate, Start

_ROLLOUT = TypeAdapter(Rollout)
_ROLLOUTS = TypeAdapter(Page[Rollout])
_ROLLOUT_OR_JOB: TypeAdapter[Rollout | Job] = TypeAdapter(Rollout | Job)
_PLAN = TypeAdapter(Plan)
_PLANS = TypeAdapter(Page[Plan])
_JOB = TypeAdapter(Job)
ANSWER_S = 60.0
"""Seconds that the service may work on a rollout before it answers."""


@dataclass(frozen=True, repr=False)
class Predicted:
    """A rollout as arrays.

    Attributes:
        rollout: the service's answer.
        times: of the frames [s], (S,), 0 at the first tick.
        points: the scene's measured points [m], (B, S, N, 3); None unless asked for.
        vertices: the graph's object vertices [m], (B, S, n, 3); None unless asked for.
    """

    rollout: Rollout
    times: Array
    points: Array | None = None
    vertices: Array | None = None

    def __repr__(self) -> str:
        shapes = ((name, getattr(self, name)) for name in ("times", "points", "vertices"))
        given = ", ".join(f"{name}={array.shape}" for name, array in shapes if array is not None)
        return f"Predicted({self.rollout.model!r}, version={self.rollout.version}, {given})"


@dataclass(frozen=True, repr=False)
class Planned:
    """A plan with its arrays: ``controllers`` (h+1+T, K, 3) is what a rollout and a robot take.

    Attributes:
        plan: the service's answer: errors, limits, cost history.
        arrays: everything of ``plan.npz`` by name; ``physworld_services.inference.plans`` lists it.
    """

    plan: Plan
    arrays: dict[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Planned({self.plan!r}, arrays={', '.join(self.arrays) or 'none'})"

    @property
    def controllers(self) -> Array:
        """All control points [m], the history's ticks first."""
        return self.arrays["controllers"]


def rollout_create(
    model: str,
    controllers: Array,
    version: int | str,
    times: Array | None,
    dt_s: float | None,
    start: Start,
    phi: Array | None,
    stiffness_factor: float,
    density_factor: float,
    returns: Sequence[Part],
    every: int,
    as_job: bool,
) -> Call[Rollout | Job]:
    """POST /v1/rollouts.

    Args:
        model: its name.
        controllers: paths (T, K, 3) or candidates (B, T, K, 3) [m].
        version: its number, or an alias.
        times: of the paths (T,) [s], from 0; None: they are ``dt_s`` apart.
        dt_s: between two places of the controllers [s]; None is the model's own.
        start: where the object is at first.
        phi: logarithms of property factors (n, ·); None is as published.
        stiffness_factor: over the whole body.
        density_factor: likewise.
        returns: vertices, points or both.
        every: every how many ticks an answer holds.
        as_job: always as a job, not only where the answer would be too large.
    """
    fields: dict[str, Any] = {
        "model": model,
        "version": version,
        "controllers": EncodedArray.of(np.asarray(controllers)),
        "start": start,
        "stiffness_factor": stiffness_factor,
        "density_factor": density_factor,
        "returns": list(returns),
        "every": every,
        "mode": "job" if as_job else "auto",
    }
    if times is not None:
        fields["times"] = np.asarray(times, dtype=np.float64).tolist()
    if dt_s is not None:
        fields["dt_s"] = dt_s
    if phi is not None:
        fields["phi"] = EncodedArray.of(np.asarray(phi))
    body = RolloutCreate(**fields)
    return Call("POST", "/v1/rollouts", _ROLLOUT_OR_JOB, body=body, read_timeout_s=ANSWER_S)


def rollout_get(rollout_id: str) -> Call[Rollout]:
    """GET /v1/rollouts/{id}."""
    return Call("GET", f"/v1/rollouts/{_part(rollout_id)}", _ROLLOUT)


def rollout_list(*, limit: int | None, cursor: str | None, model: str | None) -> Call[Page[Rollout]]:
    """GET /v1/rollouts."""
    return Call("GET", "/v1/rollouts", _ROLLOUTS, query=_given(limit=limit, cursor=cursor, model=model))


def plan_create(
    model: str,
    version: int | str,
    points: dict[int, Sequence[float]] | None,
    shape: Array | None,
    limits: PlanLimits | None,
    config: PlanConfig | None,
) -> Call[Job]:
    """POST /v1/plans; exactly one of ``points`` and ``shape``.

    Args:
        model: its name.
        version: its number, or an alias.
        points: goal (3,) [m] by index of the measured point.
        shape: goal of all vertices or points (·, 3) [m].
        limits: of the grips' motion; None has the defaults.
        config: of the search; None has the defaults.

    Raises:
        TypeError: both goals are given, or neither.
    """
    if (points is None) == (shape is None):
        raise TypeError("plans.create takes either points or shape")
    goal: PointGoal | ShapeGoal
    if points is not None:
        places = [(float(x), float(y), float(z)) for x, y, z in points.values()]
        goal = PointGoal(kind="points", index=list(points), places=places)
    else:
        goal = ShapeGoal(kind="shape", shape=EncodedArray.of(np.asarray(shape)))
    body = PlanCreate(
        model=model,
        version=version,
        goal=goal,
        limits=limits or PlanLimits(),
        config=config or PlanConfig(),
    )
    return Call("POST", "/v1/plans", _JOB, body=body)


def plan_get(plan_id: str) -> Call[Plan]:
    """GET /v1/plans/{id}."""
    return Call("GET", f"/v1/plans/{_part(plan_id)}", _PLAN)


def plan_list(*, limit: int | None, cursor: str | None, model: str | None) -> Call[Page[Plan]]:
    """GET /v1/plans."""
    return Call("GET", "/v1/plans", _PLANS, query=_given(limit=limit, cursor=cursor, model=model))


def file_of(artifacts: list[Artifact], name: str, owner: str) -> tuple[Artifact, Call[bytes]]:
    """The artifact called ``name`` and the call for its bytes. Raises ModelUnreadable where there is none."""
    found = next((item for item in artifacts if item.name == name), None)
    if found is None:
        raise ModelUnreadable(f"{owner} has no file {name}: its job has not ended")
    return found, Call("GET", artifact_path(found.sha256), BYTES)


def checked_arrays(artifact: Artifact, data: bytes) -> dict[str, Array]:
    """The arrays of an artifact. Raises DigestMismatch."""
    digest = hashlib.sha256(data).hexdigest()
    if digest != artifact.sha256:
        raise DigestMismatch(artifact.name, artifact.sha256, digest)
    return arrays_of(data)


def predicted(rollout: Rollout, arrays: dict[str, Array] | None = None) -> Predicted:
    """The arrays of an answer, or of the job's file."""
    if arrays is not None:
        return Predicted(rollout, arrays["times"], arrays.get("points"), arrays.get("vertices"))
    points, vertices = (None if part is None else part.numpy() for part in (rollout.points, rollout.vertices))
    return Predicted(rollout, np.array(rollout.times), points, vertices)
