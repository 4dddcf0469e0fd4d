"""What each kind of shard hands back, checked before anything of it is committed."""

from __future__ import annotations

import json
import math
from typing import Any

from pydantic import Field, ValidationError

from physworld_schemas.assessment import ErrorFigure, Outcome
from physworld_schemas.base import Artifact, Lineage, Resource
from physworld_schemas.fit import Parameter
from physworld_schemas.trace import Verdict
from physworld_storage.errors import ResultInvalid

MAX_EPISODES = 20_000


class ShardResult(Resource):
    """Common part of every result."""

    lineage: Lineage = Field(default_factory=Lineage)


class FitResult(ShardResult):
    """Of a ``fit`` shard."""

    parameters: dict[str, Parameter]
    metrics: dict[str, Any]
    artifacts: list[Artifact]
    seconds: float | None = None


class TraceResult(ShardResult):
    """Of a ``trace`` shard: the whole report, and the files."""

    verdict: Verdict
    report: dict[str, Any]
    artifacts: list[Artifact]


class SimulationResult(ShardResult):
    """Of a ``simulation`` shard: whether the run can be trusted; its tracks are in the scratch."""

    trusted: bool


class PlanResult(ShardResult):
    """Of a ``dataset_plan`` shard: how many episodes follow, and their size."""

    episodes: int = Field(ge=1, le=MAX_EPISODES)
    frames: int = Field(ge=1)
    particles: int = Field(ge=1)


class EpisodeResult(ShardResult):
    """Of an ``episode`` shard: where the episode was written and what it holds."""

    index: int = Field(ge=0)
    path: str = Field(min_length=1)
    digest: str = Field(pattern=r"^[0-9a-f]{64}$")
    seed: int = Field(ge=-(2**63), lt=2**63)
    frames: int = Field(ge=1)
    particles: int = Field(ge=1)
    motion: str = ""
    seconds: float | None = None


class SealResult(ShardResult):
    """Of a ``dataset_seal`` shard: ``digest`` is the manifest's."""

    digest: str = Field(pattern=r"^[0-9a-f]{64}$")
    statistics: dict[str, Any] = Field(default_factory=dict)
    artifacts: list[Artifact]


class TrainingResult(ShardResult):
    """Of a ``training`` shard: ``sha256`` is the digest of the version's manifest."""

    artifacts: list[Artifact]
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    metrics: dict[str, Any] = Field(default_factory=dict)


class RunResult(ShardResult):
    """Of a ``rollout`` or ``plan`` shard: what it says beside its files."""

    figures: dict[str, Any]
    artifacts: list[Artifact] = Field(min_length=1)


class AssessmentResult(ShardResult):
    """Of an ``assessment`` shard."""

    outcome: Outcome
    reason: str
    measured: ErrorFigure
    expected: ErrorFigure
    excess_m: float
    excess_ci95_m: tuple[float, float]
    baselines_m: dict[str, float | None] = Field(default_factory=dict)
    twin_m: float | None = None
    start_mismatch_m: float


RESULT_OF_SHARD: dict[str, type[ShardResult]] = {
    "fit": FitResult,
    "trace": TraceResult,
    "simulation": SimulationResult,
    "dataset_plan": PlanResult,
    "episode": EpisodeResult,
    "dataset_seal": SealResult,
    "training": TrainingResult,
    "assessment": AssessmentResult,
    "rollout": RunResult,
    "plan": RunResult,
}


def parse_result(kind: str, index: int, result: dict[str, Any]) -> ShardResult:
    """The result of shard ``index`` of its stage. Raises ResultInvalid naming every fault."""
    faults = [f"{path} is {value}" for path, value in _not_finite(result, "result")]
    if faults:
        raise ResultInvalid(f"{kind} result holds numbers that JSON cannot carry: {'; '.join(faults[:10])}")
    try:
        json.dumps(result)
    except TypeError as error:
        raise ResultInvalid(f"{kind} result is not JSON: {error}") from error
    try:
        parsed = RESULT_OF_SHARD[kind].model_validate(result)
    except ValidationError as error:
        details = [f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors()]
        raise ResultInvalid(f"{kind} result: {'; '.join(details)}") from error
    if isinstance(parsed, EpisodeResult) and parsed.index != index:
        raise ResultInvalid(f"episode result carries index {parsed.index}, its shard is number {index}")
    return parsed


def _not_finite(value: Any, path: str) -> list[tuple[str, float]]:
    if isinstance(value, dict):
        return [fault for key, item in value.items() for fault in _not_finite(item, f"{path}.{key}")]
    if isinstance(value, list | tuple):
        return [fault for key, item in enumerate(value) for fault in _not_finite(item, f"{path}[{key}]")]
    return [(path, value)] if isinstance(value, float) and not math.isfinite(value) else []
