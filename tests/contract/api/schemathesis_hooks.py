"""What no schema can say to a generator of requests, for ``st run`` with ``SCHEMATHESIS_HOOKS`` (docs/api.md).

A cursor is what the page before gave out, an idempotency key is new for each request, and an upload is a recording: any
other is refused with 422 as documented. The contract tests ask for these refusals themselves.
"""

from __future__ import annotations

from uuid import uuid4

import schemathesis
from schemathesis import Case, GenerationMode, HookContext


@schemathesis.hook
def before_call(context: HookContext, case: Case, kwargs: dict[str, object]) -> None:
    """Put real values in the place of generated ones, in requests that are meant to be right."""
    if case.meta is None or case.meta.generation.mode is not GenerationMode.POSITIVE:
        return
    if case.query:
        case.query.pop("cursor", None)
    if "Idempotency-Key" in (case.headers or {}):
        case.headers["Idempotency-Key"] = uuid4().hex
