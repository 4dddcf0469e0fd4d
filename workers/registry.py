"""Which function does which kind of shard; imported when the first shard of its kind arrives.

A handler is ``run(context: TaskContext, stores: Stores) -> HandlerResult``. The table holds import strings,
so that starting a worker imports neither ``torch`` nor ``warp``, and so that a service can add its own
kinds (``physworld_services.trainer`` registers ``training``) without the workers knowing of it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from physworld_workers.errors import UnknownShardKind

if TYPE_CHECKING:
    from physworld_workers.context import TaskContext
    from physworld_workers.stores import Stores


@dataclass(frozen=True)
class HandlerResult:
    """What a shard came to: a JSON-able result, and the digest of what it wrote (None: nothing)."""

    result: dict[str, Any] = field(default_factory=dict)
    digest: str | None = None


Handler = Callable[["TaskContext", "Stores"], HandlerResult]

_HANDLERS: dict[str, str] = {
    "fit": "physworld_workers.tasks.fit:run",
    "trace": "physworld_workers.tasks.trace:run",
    "simulation": "physworld_workers.tasks.shared_runs:simulate",
    "dataset_plan": "physworld_workers.tasks.dataset:plan",
    "episode": "physworld_workers.tasks.dataset:episode",
    "dataset_seal": "physworld_workers.tasks.dataset:seal",
}


def register(kind: str, target: str) -> None:
    """Let shards of ``kind`` be done by ``target`` (``module:function``)."""
    _HANDLERS[kind] = target


def handler_of(kind: str) -> Handler:
    """The handler of ``kind``, its module imported now. Raises UnknownShardKind."""
    target = _HANDLERS.get(kind)
    if target is None:
        raise UnknownShardKind(f"no handler for shard kind {kind!r}; this worker knows {sorted(_HANDLERS)}")
    module, _, function = target.partition(":")
    handler: Handler = getattr(importlib.import_module(module), function)
    return handler
