"""What an episode's twin was made of, as the exports name it: log factors of each particle, scalars of the episode."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from physworld_client.types import Array

COLUMNS = ("log_modulus", "log_density", "log_friction")


def property_names(arrays: Mapping[str, Array]) -> tuple[str, ...]:
    """Names of the columns of ``properties`` (P, 2), or (P, 3) where the ground's friction was perturbed as a field."""
    return COLUMNS[: arrays["properties"].shape[1]]


def attributes_of(arrays: Mapping[str, Array]) -> dict[str, Any]:
    """The episode's attributes; empty where it has none."""
    return json.loads(str(arrays["attributes"])) if "attributes" in arrays else {}


def scalars_of(attributes: Mapping[str, Any]) -> dict[str, float]:
    """By name: strengths of effects (``effect.strength``) and drawn parameters of the twin, in their units."""
    drawn = {**attributes.get("parameters", {}), **attributes.get("effect_strengths", {})}
    return {name: float(drawn[name]) for name in sorted(drawn)}
