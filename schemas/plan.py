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

    kind: Literal["points"] = Field(description="Goal by points.")
    index: list[Annotated[int, Field(ge=0)]] = Field(
        min_length=1, max_length=10_000, description="Measured points of the scene.", examples=[[0]]
    )
    places: list[Place] = Field(
        min_length=1,
        max_length=10_000,
        description="Where they shall be.",
        json_schema_extra={"unit": "m"},
        examples=[[[0.1, 0.0, 0.2]]],
    )

    @model_validator(mode="after")
    def _as_many(self) -> PointGoal:
        if len(self.index) != len(self.places):
            raise ValueError(f"{len(self.index)} points, but {len(self.places)} places")
        if len(set(self.index)) != len(self.index):
            raise ValueError("a point is named twice")
        return self


class ShapeGoal(Request):
    """The whole body to take a shape, a cloud of points [m], (M, 3): two-way Chamfer distance to it."""

    kind: Literal["shape"] = Field(description="Goal by shape.")
    shape: ArrayInput = Field(
        description="Points of the wanted shape, (M, 3).", json_schema_extra={"unit": "m"}
    )


class PlanLimits(Request):
    """Limits of every grip; what is not given is the recording's (``physworld.demonstrate.limits``).

    ``workspace_min_m``, ``workspace_max_m``: box of a grip's displacement from where the plan starts, which it holds.
    """

    speed_m_s: float | None = Field(
        default=None,
        gt=0,
        le=10,
        description="Greatest speed of a grip; empty: the recording's.",
        json_schema_extra={"unit": "m/s"},
        examples=[0.3],
    )
    acceleration_m_s2: float | None = Field(
        default=None,
        gt=0,
        le=200,
        description="Greatest acceleration of a grip; empty: the recording's.",
        json_schema_extra={"unit": "m/s²"},
        examples=[2.0],
    )
    workspace_min_m: Place | None = Field(
        default=None, description="Lower corner of a grip's displacement.", json_schema_extra={"unit": "m"}
    )
    workspace_max_m: Place | None = Field(
        default=None, description="Upper corner of a grip's displacement.", json_schema_extra={"unit": "m"}
    )

    @model_validator(mode="after")
    def _holds_the_start(self) -> PlanLimits:
        low, high = self.workspace_min_m or (0.0, 0.0, 0.0), self.workspace_max_m or (0.0, 0.0, 0.0)
        if max(low) > 0.0 or min(high) < 0.0:
            raise ValueError(f"the workspace {list(low)} to {list(high)} leaves out the start, 0")
        return self


class PlanConfig(Request):
    """Settings of the search (MPPI); ``horizon`` ticks of the model's clock after its start."""

    horizon: int = Field(
        default=60,
        ge=2,
        le=MAX_HORIZON,
        description="Ticks of the model's clock that the plan lasts.",
        json_schema_extra={"unit": "ticks"},
        examples=[60],
    )
    samples: int = Field(
        default=512, ge=8, le=MAX_SAMPLES, description="Motions tried in an iteration.", examples=[512]
    )
    iterations: int = Field(
        default=10, ge=1, le=MAX_ITERATIONS, description="Iterations of the search.", examples=[10]
    )
    settle: float = Field(
        default=0.2,
        ge=0,
        le=0.9,
        description="Share of the plan at its end over which the goal counts.",
        json_schema_extra={"unit": "1"},
        examples=[0.2],
    )
    seed: Seed = Field(
        default=0,
        description="Seed of every random choice; the same seed gives the same result.",
        examples=[0],
    )

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

    model: ModelName = Field(description="Name of the model.", examples=["soft_beam"])
    version: Version = Field(default="latest", description="Number, alias or `latest`.")
    goal: Annotated[PointGoal | ShapeGoal, Field(discriminator="kind")] = Field(
        description="Where the object shall be."
    )
    limits: PlanLimits = Field(default_factory=PlanLimits, description="Limits of the grips.")
    config: PlanConfig = Field(default_factory=PlanConfig, description="Settings of the search.")


class Plan(Resource):
    """A plan. Once ready its arrays lie in the artifact ``plan.npz``.

    Errors [m] are means over the settling ticks: of the model's prediction, of the twin that executes the plan, and of
    the twin when the grips do not move. ``model_against_twin_m`` is the mean distance of the two paths.
    """

    id: str = Field(description="Identifier: a prefix of its kind and 26 characters that sort by time.")
    state: RunState = Field(description="Whether the plan is there.")
    model: str = Field(description="Name of the model.", examples=["soft_beam"])
    version: int = Field(description="Version of the model.")
    created_at: datetime = Field(description="When it was made, UTC.")
    job_id: str = Field(description="Job that makes it.", examples=["job_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    config: dict[str, Any] = Field(default_factory=dict, description="Settings.")
    dt_s: float | None = Field(
        default=None, description="Tick of the model's clock.", json_schema_extra={"unit": "s"}
    )
    history: int | None = Field(
        default=None,
        description="Ticks of history that the motion begins with.",
        json_schema_extra={"unit": "ticks"},
    )
    goal: str | None = Field(default=None, description="Kind of goal.")
    predicted_error_m: float | None = Field(
        default=None,
        description="Distance from the goal as the model predicts.",
        json_schema_extra={"unit": "m"},
    )
    executed_error_m: float | None = Field(
        default=None, description="Distance from the goal in the twin.", json_schema_extra={"unit": "m"}
    )
    motionless_error_m: float | None = Field(
        default=None,
        description="Distance from the goal without any motion, in the twin.",
        json_schema_extra={"unit": "m"},
    )
    model_against_twin_m: float | None = Field(
        default=None, description="Mean distance of the two paths.", json_schema_extra={"unit": "m"}
    )
    model_against_twin_end_m: float | None = Field(
        default=None, description="The same at the end.", json_schema_extra={"unit": "m"}
    )
    cost_history: list[float] = Field(
        default_factory=list, description="Best cost of every iteration.", json_schema_extra={"unit": "m"}
    )
    limits: dict[str, Any] = Field(default_factory=dict, description="Limits that held.")
    peak_speed_m_s: float | None = Field(
        default=None, description="Greatest speed of a grip.", json_schema_extra={"unit": "m/s"}
    )
    samples: int | None = Field(default=None, description="Motions that were tried.")
    seconds: float | None = Field(
        default=None, description="Wall time that it took.", json_schema_extra={"unit": "s"}
    )
    lineage: Lineage = Field(
        default_factory=Lineage, description="What it was made from, by which code, with which seeds."
    )
    artifacts: list[Artifact] = Field(
        default_factory=list, description="Files, by name and SHA-256; download them from /v1/artifacts."
    )
