"""Fits: a calibrated twin of a scene."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from schemas.base import Artifact, Lineage, Request, Resource

ElasticLaw = Literal[
    "auto", "neo_hookean", "fixed_corotated", "st_venant_kirchhoff", "hencky", "drucker_prager_elastic",
    "transversely_isotropic", "isotropic_sheet", "orthotropic_sheet", "rod",
]  # fmt: skip
FlowLaw = Literal["identity", "von_mises", "drucker_prager", "st_venant_kirchhoff"]


class FitConfig(Request):
    """Settings of the calibration, which is deterministic: the same scene and settings give the same fit.

    ``damping``: "auto" adds air drag and internal friction where the data ask; "none" keeps the declared physics.
    ``law``: an elastic law of ``GET /v1/materials``; "auto" lets the worker's language model or cross-validation choose
    one; null is the usual one of the body's shape. ``plasticity``: a flow law, whose yield is calibrated too.
    ``formulation``: which form integrates the body; "auto" takes the one that its laws and its scene need.
    ``transfer``: how the updated Lagrangian form's particles and grid exchange velocities; "asflip" damps less.
    """

    particle_budget: int = Field(default=2000, ge=50, le=200_000)
    max_simulations: int = Field(default=400, ge=1, le=5000)
    damping: Literal["auto", "none"] = "auto"
    law: ElasticLaw | None = None
    plasticity: FlowLaw | None = None
    formulation: Literal["auto", "total_lagrangian", "updated_lagrangian"] = "auto"
    transfer: Literal["apic", "asflip"] = "apic"

    @property
    def usual_physics(self) -> bool:
        """Whether the body has its shape's usual law in the form that the engine takes: what a trace can work on."""
        return self.law is None and self.plasticity is None and self.formulation == "auto"


class FitCreate(Request):
    """Body of POST /v1/fits."""

    scene_id: str
    config: FitConfig = Field(default_factory=FitConfig)


class Parameter(Resource):
    """A calibrated quantity with its 95 % interval; ``identified`` false: held at its prior."""

    value: float
    unit: str
    ci95: tuple[float, float] | None = None
    identified: bool = True
    note: str = ""


class Fit(Resource):
    """A calibrated twin: parameters, metrics on held-out frames, ``twin.npz`` and ``report.json``."""

    id: str
    scene_id: str
    state: Literal["pending", "ready", "failed"]
    created_at: datetime
    job_id: str
    config: FitConfig
    parameters: dict[str, Parameter] = Field(default_factory=dict)
    metrics: dict[str, Any] = Field(default_factory=dict)
    lineage: Lineage = Field(default_factory=Lineage)
    artifacts: list[Artifact] = Field(default_factory=list)
