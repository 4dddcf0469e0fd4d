"""Jobs, their progress and their events."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from physworld_schemas.base import Problem, Reference, Resource

JobKind = Literal["fit", "trace", "dataset", "training", "assessment", "rollout", "plan", "pipeline"]
JobState = Literal["queued", "running", "succeeded", "failed", "cancelling", "cancelled"]
TERMINAL_STATES: frozenset[str] = frozenset({"succeeded", "failed", "cancelled"})


class Progress(Resource):
    """How far a job is: ``done`` of ``total`` ``unit`` (frames, simulations, episodes, steps)."""

    done: float = 0
    total: float = 0
    unit: str = ""
    message: str = ""


class Job(Resource):
    """A piece of work. A pipeline job owns child jobs (fit, trace, dataset, training)."""

    id: str
    kind: JobKind
    state: JobState
    progress: Progress = Field(default_factory=Progress)
    attempt: int = 0
    parent_id: str | None = None
    children: list[str] = Field(default_factory=list)
    created_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None
    heartbeat_at: datetime | None = None
    inputs: list[Reference] = Field(default_factory=list)
    outputs: list[Reference] = Field(default_factory=list)
    config: dict[str, Any] = Field(default_factory=dict)
    error: Problem | None = None
    links: dict[str, str] = Field(default_factory=dict)


class Event(Resource):
    """One entry of a job's event log; ``seq`` is the SSE id and grows over all jobs."""

    seq: int
    job_id: str
    type: Literal["state", "progress", "log"]
    at: datetime
    data: dict[str, Any] = Field(default_factory=dict)
