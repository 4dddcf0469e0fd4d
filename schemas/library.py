"""Entries of the read-only libraries."""

from __future__ import annotations

from pydantic import Field

from physworld_schemas.base import Resource


class Material(Resource):
    """A constitutive law: its strain energy density and the unit of each parameter."""

    name: str
    title: str
    energy: str
    parameters: dict[str, str] = Field(default_factory=dict)


class Effect(Resource):
    """A physical effect: what it adds to the equations and the unit of each parameter."""

    name: str
    title: str
    kind: str = ""
    law: str
    parameters: dict[str, str] = Field(default_factory=dict)
