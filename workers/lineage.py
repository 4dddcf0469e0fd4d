"""What made an object: inputs with their digests, code, configuration, seeds, device."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Sequence
from typing import Any

import physworld
from physworld_schemas.base import Lineage, Reference


def lineage_of(
    inputs: Sequence[Reference], config: dict[str, Any], seeds: dict[str, int], device: str | None = None
) -> dict[str, Any]:
    """A lineage as JSON; ``config_digest`` is the SHA-256 of the configuration with sorted keys.

    Args:
        inputs: what was read, with digests.
        config: the settings, as JSON.
        seeds: by what they are for.
        device: what computed; None stands for this machine's processor.
    """
    canonical = json.dumps(config, sort_keys=True, separators=(",", ":"), allow_nan=False)
    lineage = Lineage(
        inputs=list(inputs),
        code_version=code_version(),
        config_digest=hashlib.sha256(canonical.encode()).hexdigest(),
        seeds=seeds,
        device=device or f"cpu {platform.machine()}",
    )
    return lineage.model_dump(mode="json")


def code_version() -> str:
    """The version of this code, e.g. ``physworld 0.2.0``; the images hold it without installing a distribution."""
    return f"physworld {physworld.__version__}"
