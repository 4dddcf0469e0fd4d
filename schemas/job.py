"""Jobs, their progress and their events."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from physworld_schemas.base import RATIO, UNIT_BESIDE, Problem, Reference, Resource

JobKind = Literal[
    "tracking",
    "check",
    "fit",
    "trace",
    "dataset",
    "training",
    "assessment",
    "rollout",
    "plan",
    "video",
    "pipeline",
    "loop",
]
JobState = Literal["queued", "running", "succeeded", "failed", "cancelling", "cancelled"]
TERMINAL_STATES: frozenset[str] = frozenset({"succeeded", "failed", "cancelled"})


class Progress(Resource):
    """How far a job is: ``done`` of ``total`` ``unit`` of what it does now, and how much of the whole job that is.

    Units are frames, simulations, episodes, steps.
    """

    done: float = Field(default=0, description="How much is done.", json_schema_extra=UNIT_BESIDE)
    total: float = Field(
        default=0, description="Of how much; 0: not known yet.", json_schema_extra=UNIT_BESIDE
    )
    unit: str = Field(default="", description="What is counted.", examples=["simulations"])
    message: str = Field(default="", description="What is being done.")
    fraction: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Share of the whole job that is done, all its stages together; it never falls. null: not known.",
        json_schema_extra=RATIO,
    )
    eta_s: float | None = Field(
        default=None,
        ge=0,
        description="Until the job ends, as earlier jobs of its kind went; null: too early to tell, or it has ended.",
        json_schema_extra={"unit": "s"},
    )

    figures: dict[str, float] = Field(
        default_factory=dict,
        description="Newest figures of the work; of a training `loss` (share of the prior's error) and `validation_m`.",
    )

    @property
    def share(self) -> float:
        """How much is done, 0 to 1: ``fraction`` where it is known, else what is counted."""
        if self.fraction is not None:
            return self.fraction
        return min(1.0, max(0.0, self.done / self.total)) if self.total > 0 else 0.0


class Job(Resource):
    """A piece of work. A pipeline and a loop own child jobs (fit, trace, dataset, training, assessment)."""

    id: str = Field(description="Identifier: a prefix of its kind and 26 characters that sort by time.")
    kind: JobKind = Field(description="What it does.")
    state: JobState = Field(description="Where it is.")
    progress: Progress = Field(default_factory=Progress, description="How far it is.")
    attempt: int = Field(default=0, description="Attempts so far.")
    parent_id: str | None = Field(
        default=None, description="Pipeline or loop that it belongs to; null: none."
    )
    children: list[str] = Field(default_factory=list, description="Jobs of a pipeline or a loop, in order.")
    created_at: datetime = Field(description="When it was made, UTC.")
    started_at: datetime | None = Field(default=None, description="When a worker first took it.")
    finished_at: datetime | None = Field(default=None, description="When it ended.")
    heartbeat_at: datetime | None = Field(default=None, description="When a worker last reported.")
    inputs: list[Reference] = Field(default_factory=list, description="What it works on.")
    outputs: list[Reference] = Field(default_factory=list, description="What it makes.")
    config: dict[str, Any] = Field(default_factory=dict, description="Settings.")
    error: Problem | None = Field(default=None, description="Why it failed; null: it did not.")
    links: dict[str, str] = Field(default_factory=dict, description="Addresses of what belongs to it.")

    @property
    def share(self) -> float:
        """How much of it is done, 0 to 1."""
        return 1.0 if self.state == "succeeded" else self.progress.share


class Event(Resource):
    """One entry of a job's event log; ``seq`` is the SSE id and grows over all jobs."""

    seq: int = Field(description="Number of the event over all jobs; the SSE id.")
    job_id: str = Field(description="Job that it is of.")
    type: Literal["state", "progress", "log"] = Field(description="Kind of event.")
    at: datetime = Field(description="When, UTC.")
    data: dict[str, Any] = Field(default_factory=dict, description="What happened.")
