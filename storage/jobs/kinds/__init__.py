"""Every kind of job and of shard, by name.

``physworld_schemas.job.JobKind`` is the list: each name on it is a module here, whose ``KIND`` says everything of it.
"""

from __future__ import annotations

import importlib
import json
import math
from typing import Any, get_args

from pydantic import ValidationError

from physworld_schemas.job import JobKind as Name
from physworld_storage.errors import ResultInvalid
from physworld_storage.jobs.kind import JobKind, ShardKind, ShardResult
from physworld_storage.tables import JobRow

KINDS: dict[str, JobKind] = {
    name: importlib.import_module(f"{__name__}.{name}").KIND for name in get_args(Name)
}
SHARDS: dict[str, ShardKind[Any]] = {shard.name: shard for kind in KINDS.values() for shard in kind.shards}
MAKERS = {kind.makes: kind for kind in KINDS.values()}
"""Kinds of jobs by the kind of what they make."""


def kind_of(job: JobRow) -> JobKind:
    """The kind of a stored job."""
    return KINDS[job.kind]


def parse_result(kind: str, index: int, result: dict[str, Any]) -> ShardResult:
    """What a shard handed back, checked before anything of it is committed. Raises ResultInvalid naming every fault.

    Args:
        kind: of the shard.
        index: of the shard in its stage.
        result: as the handler returned it.
    """
    faults = [f"{path} is {value}" for path, value in _not_finite(result, "result")]
    if faults:
        raise ResultInvalid(f"{kind} result holds numbers that JSON cannot carry: {'; '.join(faults[:10])}")
    try:
        json.dumps(result)
    except TypeError as error:
        raise ResultInvalid(f"{kind} result is not JSON: {error}") from error
    try:
        parsed: ShardResult = SHARDS[kind].result.model_validate(result)
    except ValidationError as error:
        details = [f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors()]
        raise ResultInvalid(f"{kind} result: {'; '.join(details)}") from error
    misplaced = parsed.fault_at(index)
    if misplaced is not None:
        raise ResultInvalid(misplaced)
    return parsed


def _not_finite(value: Any, path: str) -> list[tuple[str, float]]:
    if isinstance(value, dict):
        return [fault for key, item in value.items() for fault in _not_finite(item, f"{path}.{key}")]
    if isinstance(value, list | tuple):
        return [fault for key, item in enumerate(value) for fault in _not_finite(item, f"{path}[{key}]")]
    return [(path, value)] if isinstance(value, float) and not math.isfinite(value) else []
