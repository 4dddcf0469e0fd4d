"""Plans: a motion of the grips that brings the object to a goal."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from physworld_schemas.arrays import FARTHEST_M, ArrayInput
from physworld_schemas.base import Artifact, Lineage, Request, Resource, Seed
from physworld_schemas.rollout import ModelName, RunState, Version

MAX_HORIZON, MAX_SAMPLES, MAX_ITERATIONS, MAX_PLAN_STEPS = 300, 8192, 100, 20_000_000

Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
Place = tuple[Coordinate, Coordinate, Coordinate]


class PointGoal(Request):
    """Measured points ``index`` of the scene, (M,), to be at ``places`` [m], (M, 3)."""

    kind: Literal["points"] = "points"
    index: list[Annotated[int, Field(ge=0)]] = Field(min_length=1, max_length=10_000)
    places: list[Place] = Field(min_length=1, max_length=10_000)

    @model_validator(mode="after")
    def _as_many(self) -> PointGoal:
        if len(self.index) != len(self.places):
            raise ValueError(f"{len(self.index)} points, but {len(self.places)} places")
        if len(set(self.index)) != len(self.index):
            raise ValueError("a point is named twice")
        return self


class ShapeGoal(Request):
    """The whole body to take a shape, a cloud of points [m], (M, 3): two-way Chamfer distance to it."""

    kind: Literal["shape"] = "shape"
    shape: ArrayInput


class PlanLimits(Request):
    """Limits of every grip; what is not given is the recording's (``physworld.demonstrate.limits``).

    ``workspace_min_m``, ``workspace_max_m``: box of a grip's displacement from where the plan starts, which it holds.
    """

    speed_m_s: float | None = Field(default=None, gt=0, le=10)
    acceleration_m_s2: float | None = Field(default=None, gt=0, le=200)
    workspace_min_m: Place | None = None
    workspace_max_m: Place | None = None

    @model_validator(mode="after")
    def _holds_the_start(self) -> PlanLimits:
        low, high = self.workspace_min_m or (0.0, 0.0, 0.0), self.workspace_max_m or (0.0, 0.0, 0.0)
        if max(low) > 0.0 or min(high) < 0.0:
            raise ValueError(f"the workspace {list(low)} to {list(high)} leaves out the start, 0")
        return self


class PlanConfig(Request):
    """Settings of the search (MPPI); ``horizon`` ticks of the model's clock after its start."""

    horizon: int = Field(default=60, ge=2, le=MAX_HORIZON)
    samples: int = Field(default=512, ge=8, le=MAX_SAMPLES)
    iterations: int = Field(default=10, ge=1, le=MAX_ITERATIONS)
    settle: float = Field(default=0.2, ge=0, le=0.9)
    seed: Seed = 0

    @model_validator(mode="after")
    def _not_too_many(self) -> PlanConfig:
        steps = self.horizon * self.samples * self.iterations
        if steps > MAX_PLAN_STEPS:
            raise ValueError(
                f"horizon {self.horizon} x samples {self.samples} x iterations {self.iterations} = {steps} steps of "
                f"the model; the limit is {MAX_PLAN_STEPS}"
            )
        return self


class PlanCreate(Request):
    """Body of POST /v1/plans."""

    model: ModelName
    version: Version = "latest"
    goal: Annotated[PointGoal | ShapeGoal, Field(discriminator="kind")]
    limits: PlanLimits = Field(default_factory=PlanLimits)
    config: PlanConfig = Field(default_factory=PlanConfig)


class Plan(Resource):
    """A plan. Once ready its arrays lie in the artifact ``plan.npz``.

    Errors [m] are means over the settling ticks: of the model's prediction, of the twin that executes the plan, and of
    the twin when the grips do not move. ``model_against_twin_m`` is the mean distance of the two paths.
    """

    id: str
    state: RunState
    model: str
    version: int
    created_at: datetime
    job_id: str
    config: dict[str, Any] = Field(default_factory=dict)
    dt_s: float | None = None
    history: int | None = None
    goal: str | None = None
    predicted_error_m: float | None = None
    executed_error_m: float | None = None
    motionless_error_m: float | None = None
    model_against_twin_m: float | None = None
    model_against_twin_end_m: float | None = None
    cost_history: list[float] = Field(default_factory=list)
    limits: dict[str, Any] = Field(default_factory=dict)
    peak_speed_m_s: float | None = None
    samples: int | None = None
    seconds: float | None = None
    lineage: Lineage = Field(default_factory=Lineage)
    artifacts: list[Artifact] = Field(default_factory=list)
