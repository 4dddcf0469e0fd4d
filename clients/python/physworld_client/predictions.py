"""What rollouts and plans are as arrays; shared by both clients."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from physworld_client.arrays import arrays_of
from physworld_client.calls import Call, route
from physworld_client.errors import DigestMismatch, ModelUnreadable
from physworld_client.types import Array, Plan, Rollout
from physworld_schemas.arrays import EncodedArray
from physworld_schemas.base import Artifact
from physworld_schemas.plan import PointGoal, ShapeGoal


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


def goal_of(points: dict[int, Sequence[float]] | None, shape: Array | None) -> PointGoal | ShapeGoal:
    """The goal of a plan: (3,) [m] by index of the measured point, or all vertices or points (·, 3) [m].

    Raises:
        TypeError: both are given, or neither.
    """
    if (points is None) == (shape is None):
        raise TypeError("plans.create takes either points or shape")
    if points is None:
        return ShapeGoal(kind="shape", shape=EncodedArray.of(np.asarray(shape)))
    places = [(float(x), float(y), float(z)) for x, y, z in points.values()]
    return PointGoal(kind="points", index=list(points), places=places)


def file_of(artifacts: list[Artifact], name: str, owner: str) -> tuple[Artifact, Call[bytes]]:
    """The artifact called ``name`` and the call for its bytes. Raises ModelUnreadable where there is none."""
    found = next((item for item in artifacts if item.name == name), None)
    if found is None:
        raise ModelUnreadable(f"{owner} has no file {name}: its job has not ended")
    return found, Call("GET", route("artifacts", found.sha256), bytes)


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
