"""Object ids: a three-letter prefix and a ULID, so that they sort by time and can be grepped."""

from __future__ import annotations

from ulid import ULID

PREFIXES = {
    "scene": "scn",
    "fit": "fit",
    "trace": "trc",
    "check": "chk",
    "dataset": "dst",
    "assessment": "ass",
    "rollout": "rol",
    "plan": "pln",
    "video": "vid",
    "job": "job",
    "shard": "shd",
    "key": "key",
    "request": "req",
}


def new_id(kind: str) -> str:
    """A new id of the given kind, e.g. ``scn_01JD…``. Raises KeyError for an unknown kind."""
    return f"{PREFIXES[kind]}_{ULID()}"
