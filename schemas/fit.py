"""Fits: a calibrated twin of a scene."""

from __future__ import annotations

from datetime import datetime
from math import prod
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from physworld_schemas.base import UNIT_BESIDE, Artifact, Lineage, Request, Resource
from physworld_schemas.library import NamesOf
from physworld_schemas.standing import standing_of

MOST_PARTICLES = 200_000
MOST_RECORDINGS = 8
"""Further ones of an object, beside the first."""


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

    particle_budget: int = Field(
        default=2000,
        ge=50,
        le=MOST_PARTICLES,
        description="Particles of the simulated body: more are finer and slower.",
        json_schema_extra={"unit": "particles"},
        examples=[2000],
    )
    max_simulations: int = Field(
        default=400,
        ge=1,
        le=5000,
        description="Simulations that the search may spend.",
        json_schema_extra={"unit": "simulations"},
        examples=[400],
    )
    damping: Literal["auto", "none"] = Field(
        default="auto",
        description="Add air drag and internal friction where the data ask (auto), or keep the declared physics.",
    )
    law: Annotated[str, NamesOf("law")] | None = Field(
        default=None,
        description="Constitutive law; empty: the usual one of the body's shape; auto: choose by validation.",
    )
    plasticity: Annotated[str, NamesOf("flow law")] | None = Field(
        default=None, description="Flow law, whose yield stress is calibrated too; empty: elastic."
    )
    formulation: Literal["auto", "total_lagrangian", "updated_lagrangian", "discrete_rod"] = Field(
        default="auto", description="How the body is integrated; auto takes what its laws and scene need."
    )
    transfer: Literal["apic", "asflip"] = Field(
        default="apic",
        description="How particles and grid exchange velocities (updated Lagrangian form); asflip damps less.",
    )
    mesh: str | None = Field(
        default=None,
        pattern=r"^[1-9]\d{0,2}x[1-9]\d{0,2}(odd)?$",
        description="Cells along both sides of a sheet of triangles; `odd`: diagonals the other way round.",
        examples=["16x15"],
    )
    stages: Literal["global", "global+local"] = Field(
        default="global",
        description="One homogeneous material, or then a field of stiffness, kept only if validation improves.",
    )
    numerics: bool = Field(
        default=True, description="Measure the engine's own damping and the error of its cells."
    )

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


FURTHER: Any = Field(
    default_factory=list,
    max_length=MOST_RECORDINGS,
    description="Further recordings of the same object, fitted together.",
)
"""The field of a request that names them."""


def require_each_once(*scene_ids: str) -> None:
    """Raises ValueError where a recording comes more than once."""
    twice = sorted({known for known in scene_ids if scene_ids.count(known) > 1})
    if twice:
        raise ValueError(f"a recording is fitted or held out, once: {', '.join(twice)} came more than once")


def require_no_field(config: FitConfig, scene_ids: list[str]) -> None:
    """Raises ValueError where a field over the body is asked for of several recordings."""
    if scene_ids and config.stages != "global":
        raise ValueError(
            f"the local stage of stages {config.stages!r} fits a field to one recording; scene_ids adds "
            f"{len(scene_ids)}"
        )


class FitCreate(Request):
    """Body of POST /v1/fits.

    ``scene_ids`` are further recordings of the same object: one material for all, and of each its own body, start and
    grips. A field over the body (``stages``) is fitted to one recording.
    """

    scene_id: str = Field(
        description="Scene to calibrate a twin of.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    scene_ids: list[str] = FURTHER
    config: FitConfig = Field(default_factory=FitConfig, description="Settings.")

    @model_validator(mode="after")
    def _several(self) -> Self:
        require_each_once(self.scene_id, *self.scene_ids)
        require_no_field(self.config, self.scene_ids)
        return self


class Parameter(Resource):
    """A calibrated quantity with its 95 % interval, null where none can be given.

    ``identified`` false: the data were not shown to fix it, and ``note`` says why: it was held at its prior, or the
    search did not end by itself.
    """

    value: float = Field(description="Calibrated value.", json_schema_extra=UNIT_BESIDE)
    unit: str = Field(description="Unit of the value; `1` has none.", examples=["Pa"])
    ci95: tuple[float, float] | None = Field(
        default=None,
        description="95 % interval, in the same unit; null where none can be given.",
        json_schema_extra=UNIT_BESIDE,
    )
    identified: bool = Field(
        default=True,
        description="Whether the data fix it; false: it was held at its prior or the search did not end.",
    )
    note: str = Field(default="", description="Why it is not identified, or what else to know.")


class Numerics(Resource):
    """What the engine itself does to a twin's prediction of its scene, by runs without any friction and on finer cells.

    ``equivalent_drag_per_s``: linear drag that would lose as much energy; ``damping_ratio``: the same as a share of
    critical damping of the mode at ``dominant_mode_hz``; ``half_step_m`` and ``finer_cells_m``: root mean squared
    change of the predicted tracks with half the time step, and with cells ``refinement`` times smaller [m].
    """

    equivalent_drag_per_s: float = Field(
        description="Linear drag that loses as much energy as the engine itself.",
        json_schema_extra={"unit": "1/s"},
    )
    damping_ratio: float | None = Field(
        default=None, description="The same, as a share of critical damping.", json_schema_extra={"unit": "1"}
    )
    dominant_mode_hz: float | None = Field(
        default=None, description="Mode that the ratio is of.", json_schema_extra={"unit": "Hz"}
    )
    lost_share: float = Field(description="Share of the energy lost.", json_schema_extra={"unit": "1"})
    time_step_s: float = Field(description="Time step.", json_schema_extra={"unit": "s"})
    half_step_m: float = Field(
        description="RMS change of the tracks with half the step.", json_schema_extra={"unit": "m"}
    )
    finer_cells_m: float = Field(
        description="RMS change of the tracks with finer cells.", json_schema_extra={"unit": "m"}
    )
    refinement: float = Field(
        description="How many times finer those cells were.", json_schema_extra={"unit": "1"}
    )
    particles: int = Field(description="Particles of the twin.")
    finer_particles: int = Field(description="Particles of the finer run.")
    simulations: int = Field(description="Simulations that were run.")
    seconds: float = Field(description="Wall time that it took.", json_schema_extra={"unit": "s"})


class SearchState(Resource):
    """Whether the search converged, which is so only where every search of the fit ended by itself.

    ``open`` says why not, by parameter (``law``: the choice of it). A search that spent ``max_simulations``
    leaves the best found so far, without intervals.
    """

    converged: bool = Field(description="Whether every search ended by itself.")
    open: dict[str, str] = Field(default_factory=dict, description="Why not, by parameter.")


class LocalStage(Resource):
    """What the local stage found: whether its field was kept and why, and the error that it left.

    ``validation``: error on the frames that the search did not see over the homogeneous twin's, by the strength of the
    field's prior. ``log_factors``: mean and ends of each field that was searched. ``held``: why others were not.
    """

    kept: bool = Field(description="Whether the field was kept.")
    reason: str = Field(description="Why.")
    held: dict[str, str] = Field(default_factory=dict, description="Fields that were not searched, and why.")
    strength: float | None = Field(
        default=None, description="Strength of the prior that was chosen.", json_schema_extra={"unit": "1"}
    )
    validation: dict[str, float | None] = Field(
        default_factory=dict,
        description="Validation error over the homogeneous twin's, by strength of the prior.",
        json_schema_extra={"unit": "1"},
    )
    log_factors: dict[str, dict[str, float]] = Field(
        default_factory=dict,
        description="Mean and ends of each field's log factor.",
        json_schema_extra={"unit": "1"},
    )
    runs: int = Field(default=0, description="Searches.")
    simulations: int = Field(default=0, description="Simulations that were run.")
    seconds: float | None = Field(
        default=None, description="Wall time that it took.", json_schema_extra={"unit": "s"}
    )


class Fit(Resource):
    """A calibrated twin: parameters, metrics on held-out frames, ``twin.npz`` and ``report.json``.

    Of several recordings ``metrics`` has the errors of each in ``recordings``, and in ``agreement`` how far the own
    optimum of each lies off the common one; their twins are ``twin_2.npz`` and so on.

    ``numerics``, and ``converged``, the searched parameters extrapolated to cells of no size, are null where they were
    not measured; ``not_measured`` says why. ``local`` is null where no local stage was asked for. ``notes`` say how
    the body was built.
    """

    id: str = Field(description="Identifier: a prefix of its kind and 26 characters that sort by time.")
    scene_id: str = Field(description="Scene that it is about.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    scene_ids: list[str] = Field(default_factory=list, description="Further recordings.")
    state: Literal["pending", "ready", "failed", "cancelled"] = Field(
        description="Whether the twin is there."
    )
    created_at: datetime = Field(description="When it was made, UTC.")
    job_id: str = Field(description="Job that makes it.", examples=["job_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    config: FitConfig = Field(description="Settings.")
    parameters: dict[str, Parameter] = Field(
        default_factory=dict, description="Calibrated quantities by name."
    )
    metrics: dict[str, Any] = Field(
        default_factory=dict, description="Errors on the held-out frames and more."
    )
    numerics: Numerics | None = Field(
        default=None, description="What the engine adds by itself; null: not measured."
    )
    converged: dict[str, Parameter] | None = Field(
        default=None, description="Parameters extrapolated to cells of no size; null: not measured."
    )
    not_measured: str = Field(default="", description="Why numerics are missing.")
    search: SearchState | None = Field(default=None, description="Whether the search converged.")
    local: LocalStage | None = Field(
        default=None, description="What the local stage found; null: not asked for."
    )
    notes: list[str] = Field(default_factory=list, description="How the body was built.")
    lineage: Lineage = Field(
        default_factory=Lineage, description="What it was made from, by which code, with which seeds."
    )
    artifacts: list[Artifact] = Field(
        default_factory=list, description="Files, by name and SHA-256; download them from /v1/artifacts."
    )

    @property
    def standing(self) -> str:
        """Its state, or "not converged" where a search spent its budget."""
        return standing_of(self.state, converged=self.search.converged if self.search else None)
