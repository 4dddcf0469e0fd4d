"""Fits: a calibrated twin of a scene."""

from __future__ import annotations

from datetime import datetime
from math import prod
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from physworld_schemas.base import Artifact, Lineage, Request, Resource
from physworld_schemas.library import NamesOf

MOST_PARTICLES = 200_000


class FitConfig(Request):
    """Settings of the calibration, which is deterministic: the same scene and settings give the same fit.

    ``damping``: "auto" adds air drag and internal friction where the data ask; "none" keeps the declared physics.
    ``law``: an elastic law of ``GET /v1/materials``; "auto" lets the worker's language model or cross-validation choose
    one; null is the usual one of the body's shape. ``plasticity``: a flow law, whose yield is calibrated too.
    ``formulation``: which form integrates the body; "auto" takes the one that its laws and its scene need.
    ``transfer``: how the updated Lagrangian form's particles and grid exchange velocities; "asflip" damps less.
    ``mesh``: of a sheet that another engine recorded as a mesh of triangles, its cells along both sides, such as
    "16x15"; "16x15odd" has the diagonals the other way round. Four particles a cell, 200 000 at most. Null is a plate.
    ``stages``: "global+local" then fits a field of stiffness, and of the ground's friction where the data know it, over
    the body; it is kept only if training frames that its search did not see get better.
    ``numerics``: measure the engine's own damping on the scene, and the numbers with cells of no size.
    """

    particle_budget: int = Field(default=2000, ge=50, le=MOST_PARTICLES)
    max_simulations: int = Field(default=400, ge=1, le=5000)
    damping: Literal["auto", "none"] = "auto"
    law: Annotated[str, NamesOf("law")] | None = None
    plasticity: Annotated[str, NamesOf("flow law")] | None = None
    formulation: Literal["auto", "total_lagrangian", "updated_lagrangian", "discrete_rod"] = "auto"
    transfer: Literal["apic", "asflip"] = "apic"
    mesh: str | None = Field(default=None, pattern=r"^[1-9]\d{0,2}x[1-9]\d{0,2}(odd)?$")
    stages: Literal["global", "global+local"] = "global"
    numerics: bool = True

    @model_validator(mode="after")
    def _small_enough(self) -> Self:
        if self.mesh is not None:
            particles = 4 * prod(int(count) for count in self.mesh.removesuffix("odd").split("x"))
            if particles > MOST_PARTICLES:
                raise ValueError(f"mesh {self.mesh} has {particles} particles; {MOST_PARTICLES} are the most")
        return self

    @model_validator(mode="after")
    def _differentiable(self) -> Self:
        flows = self.plasticity not in (None, "identity")
        if self.stages != "global" and (flows or self.formulation == "updated_lagrangian"):
            raise ValueError(
                "the local stage of stages 'global+local' needs the total Lagrangian form: plasticity and formulation "
                "must be left out"
            )
        if self.stages != "global" and self.mesh is not None:
            raise ValueError(
                f"the local stage of stages 'global+local' needs gradients, which mesh {self.mesh} lacks"
            )
        return self

    @property
    def usual_physics(self) -> bool:
        """Whether the body is homogeneous, of its shape's usual law, in the form that the engine takes.

        That is what a trace can work on, on the mesh that it names if it names one.
        """
        usual_form = self.plasticity is None and self.formulation == "auto"
        return self.law is None and usual_form and self.stages == "global"


class FitCreate(Request):
    """Body of POST /v1/fits."""

    scene_id: str
    config: FitConfig = Field(default_factory=FitConfig)


class Parameter(Resource):
    """A calibrated quantity with its 95 % interval, null where none can be given.

    ``identified`` false: the data were not shown to fix it, and ``note`` says why: it was held at its prior, or the
    search did not end by itself.
    """

    value: float
    unit: str
    ci95: tuple[float, float] | None = None
    identified: bool = True
    note: str = ""


class Numerics(Resource):
    """What the engine itself does to a twin's prediction of its scene, by runs without any friction and on finer cells.

    ``equivalent_drag_per_s``: linear drag that would lose as much energy; ``damping_ratio``: the same as a share of
    critical damping of the mode at ``dominant_mode_hz``; ``half_step_m`` and ``finer_cells_m``: root mean squared
    change of the predicted tracks with half the time step, and with cells ``refinement`` times smaller [m].
    """

    equivalent_drag_per_s: float
    damping_ratio: float | None = None
    dominant_mode_hz: float | None = None
    lost_share: float
    time_step_s: float
    half_step_m: float
    finer_cells_m: float
    refinement: float
    particles: int
    finer_particles: int
    simulations: int
    seconds: float


class SearchState(Resource):
    """Whether the search converged, which is so only where every search of the fit ended by itself.

    ``open`` says why not, by parameter (``law``: the choice of it). A search that spent ``max_simulations``
    leaves the best found so far, without intervals.
    """

    converged: bool
    open: dict[str, str] = Field(default_factory=dict)


class LocalStage(Resource):
    """What the local stage found: whether its field was kept and why, and the error that it left.

    ``validation``: error on the frames that the search did not see over the homogeneous twin's, by the strength of the
    field's prior. ``log_factors``: mean and ends of each field that was searched. ``held``: why others were not.
    """

    kept: bool
    reason: str
    held: dict[str, str] = Field(default_factory=dict)
    strength: float | None = None
    validation: dict[str, float | None] = Field(default_factory=dict)
    log_factors: dict[str, dict[str, float]] = Field(default_factory=dict)
    runs: int = 0
    simulations: int = 0
    seconds: float | None = None


class Fit(Resource):
    """A calibrated twin: parameters, metrics on held-out frames, ``twin.npz`` and ``report.json``.

    ``numerics``, and ``converged``, the searched parameters extrapolated to cells of no size, are null where they were
    not measured; ``not_measured`` says why. ``local`` is null where no local stage was asked for. ``notes`` say how
    the body was built.
    """

    id: str
    scene_id: str
    state: Literal["pending", "ready", "failed"]
    created_at: datetime
    job_id: str
    config: FitConfig
    parameters: dict[str, Parameter] = Field(default_factory=dict)
    metrics: dict[str, Any] = Field(default_factory=dict)
    numerics: Numerics | None = None
    converged: dict[str, Parameter] | None = None
    not_measured: str = ""
    search: SearchState | None = None
    local: LocalStage | None = None
    notes: list[str] = Field(default_factory=list)
    lineage: Lineage = Field(default_factory=Lineage)
    artifacts: list[Artifact] = Field(default_factory=list)
