"""World models: a name, integer versions that only grow, aliases that move."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, computed_field, field_validator

from physworld_schemas.base import UNIT_OF_METRIC, Artifact, Lineage, Request, Resource, Seed, Tag
from physworld_schemas.quality import Quality, quality_of
from physworld_schemas.standing import standing_of

Format = Literal["torch_export", "onnx"]
FORMATS: tuple[Format, ...] = get_args(Format)


class TrainingConfig(Request):
    """Settings of the graph network (paper, section GNN-Based World Models) and of its training.

    The defaults are meant for some minutes on one core. ``patience``: validations without a better one after which
    the training ends (0: never). ``start_share`` below 1: the training may begin once that share of the dataset's
    episodes is committed, and takes the others in as it goes (``physworld.worldmodel.training``). ``prior``: what the
    network corrects; ``auto``: of a rope the prior whose network errs less after an eighth of the steps; ``none``: it
    stands alone. ``frame``: the axes of a step, ``world``, ``grip`` (the grip's frame,
    where the scene has one) or ``auto``: what errs less on episodes that are not learned from. ``near_edges``:
    ``current`` finds the neighbours anew at every step, so that parts of the object that meet see each other.
    ``start_from``: a version, perhaps of another object, from whose network the training goes on.
    ``holding``: where grips let go, a version for one set of those that hold; a rollout goes from one version to the
    next as the set changes (``physworld.worldmodel.holding``).
    """

    hidden: int = Field(
        default=48,
        ge=8,
        le=1024,
        description="Width of the network's layers.",
        json_schema_extra={"unit": "units"},
        examples=[48],
    )
    message_passing_steps: int = Field(
        default=3, ge=1, le=20, description="Rounds of messages along the graph's edges.", examples=[3]
    )
    history: int = Field(
        default=3,
        ge=1,
        le=10,
        description="Frames of motion that the network sees.",
        json_schema_extra={"unit": "frames"},
        examples=[3],
    )
    look_ahead: int = Field(
        default=24,
        ge=1,
        le=200,
        description="Frames that a training rollout lasts.",
        json_schema_extra={"unit": "frames"},
        examples=[24],
    )
    vertices: int = Field(default=100, ge=4, le=1000, description="Vertices of the graph.", examples=[100])
    steps: int = Field(
        default=1200,
        ge=1,
        le=1_000_000,
        description="Most training steps.",
        json_schema_extra={"unit": "steps"},
        examples=[1200],
    )
    batch_size: int = Field(default=6, ge=1, le=256, description="Rollouts of a training step.", examples=[6])
    learning_rate: float = Field(
        default=1e-3,
        gt=0,
        le=1,
        description="Step length of the optimiser (Adam).",
        json_schema_extra={"unit": "1"},
        examples=[0.001],
    )
    prior: Literal["auto", "modal", "chain", "none"] = Field(
        default="auto", description="What the network corrects; none: it stands alone."
    )
    frame: Literal["auto", "world", "grip"] = Field(
        default="auto",
        description="Axes of a step: the world's, the grip's, or what errs less on episodes that are not learned from.",
        examples=["auto"],
    )
    near_edges: Literal["material", "current"] = Field(
        default="material",
        description="Neighbours fixed in the material, or found anew at every step (parts that meet).",
    )
    holding: list[Annotated[int, Field(ge=0, le=1000)]] | None = Field(
        default=None,
        min_length=1,
        max_length=1000,
        description="Numbers of the grips that hold, from 0: the version learns from the spans of the demonstrations "
        "in which exactly these hold; null: all.",
        examples=[[0]],
    )
    start_from: str | None = Field(
        default=None,
        pattern=r"^[a-z0-9][a-z0-9._-]{0,63}:[a-z0-9][a-z0-9._-]{0,63}$",
        description="Ready version `name:version` (number or alias) whose network the training goes on from, of the "
        "same `hidden`, `message_passing_steps` and `history`; null: random weights.",
        examples=["soft_beam:3"],
    )
    patience: int = Field(
        default=8,
        ge=0,
        le=1000,
        description="Validations without a better one that end the training; 0: never.",
        examples=[8],
    )
    start_share: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="Share of the episodes that must be there before the training begins.",
        json_schema_extra={"unit": "1"},
        examples=[1.0],
    )
    fine_tune_steps: int = Field(
        default=60,
        ge=0,
        le=10_000,
        description="Steps of fine-tuning on the recording's training frames; 0: none.",
        json_schema_extra={"unit": "steps"},
        examples=[60],
    )
    formats: list[Format] = Field(
        default_factory=lambda: [*FORMATS],
        max_length=2,
        description="Programs of one step to publish beside the weights.",
    )
    seed: Seed = Field(
        default=0,
        description="Seed of every random choice; the same seed gives the same result.",
        examples=[0],
    )

    @field_validator("holding")
    @classmethod
    def _each_grip_once(cls, holding: list[int] | None) -> list[int] | None:
        if holding is not None and len(set(holding)) < len(holding):
            raise ValueError("names a grip twice")
        return None if holding is None else sorted(holding)


class TrainingCreate(Request):
    """Body of POST /v1/models: trains on a sealed dataset and publishes the next version of ``name``."""

    name: str = Field(
        pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$",
        description="Model whose next version is trained: lower case, digits, . _ -",
        examples=["soft_beam"],
    )
    dataset_id: str = Field(
        description="Sealed dataset to learn from.", examples=["dst_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    config: TrainingConfig = Field(default_factory=TrainingConfig, description="Settings.")
    description: str = Field(
        default="", max_length=10_000, description="Description of the version, for people."
    )
    tags: list[Tag] = Field(default_factory=list, max_length=50, description="Tags of the version.")


class ModelVersion(Resource):
    """A published version; immutable once ready. ``sha256`` is the digest of its manifest.

    ``quality``: the verdict of the gate; a version that failed it stays ready and is never ``latest``.
    """

    name: str = Field(description="Name of the model.")
    version: int = Field(description="Number; it only grows.")
    state: Literal["pending", "ready", "failed", "cancelled"] = Field(
        description="`ready` never changes again."
    )
    message: str = Field(default="", description="Why it failed, or what to know.")
    created_at: datetime = Field(description="When it was made, UTC.")
    job_id: str | None = Field(
        default=None, description="Job that makes it.", examples=["job_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    scene_id: str | None = Field(
        default=None, description="Scene that it is about.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    fit_id: str | None = Field(
        default=None, description="Fit whose twin is used.", examples=["fit_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    trace_id: str | None = Field(default=None, description="Trace whose effect the twin carries; null: none.")
    dataset_id: str | None = Field(default=None, description="Dataset that it was trained on.")
    description: str = Field(default="", description="Description for people.")
    tags: list[str] = Field(default_factory=list, description="Tags.")
    aliases: list[str] = Field(default_factory=list, description="Aliases that point here.")
    config: TrainingConfig = Field(default_factory=TrainingConfig, description="Settings.")
    metrics: dict[str, Any] = Field(
        default_factory=dict, description="Errors on the held-out frames, speeds, times."
    )
    sha256: str | None = Field(default=None, description="SHA-256 of the manifest; null until ready.")
    lineage: Lineage = Field(
        default_factory=Lineage, description="What it was made from, by which code, with which seeds."
    )
    artifacts: list[Artifact] = Field(
        default_factory=list, description="Files, by name and SHA-256; download them from /v1/artifacts."
    )

    @computed_field  # type: ignore[prop-decorator]  # pydantic's own advice
    @property
    def quality(self) -> Quality:
        """The verdict of the gate, from the metrics."""
        return quality_of(self.metrics)

    @property
    def standing(self) -> str:
        """Its state, or "failed the gate" where it is ready and worse than a baseline."""
        return standing_of(self.state, verdict=self.quality.verdict)


class Model(Resource):
    """A registered name with its aliases.

    ``latest_version``: the newest number, whatever became of it; ``latest``: what that word stands for, the newest
    version that is ready and did not fail the quality gate.
    """

    name: str = Field(description="Registered name.")
    created_at: datetime = Field(description="When it was made, UTC.")
    latest_version: int | None = Field(default=None, description="Newest number; null: none yet.")
    latest: int | None = Field(
        default=None, description="Newest number that did not fail the quality gate; null: none."
    )
    aliases: dict[str, int] = Field(default_factory=dict, description="Versions by alias.")


class AliasSet(Request):
    """Body of PUT /v1/models/{name}/aliases/{alias}."""

    version: int = Field(ge=1, lt=2**31, description="Ready version to point at.", examples=[2])


class VersionPatch(Request):
    """Body of PATCH /v1/models/{name}/versions/{version}: the two fields that are not part of what was published."""

    description: str | None = Field(
        default=None, max_length=10_000, description="New description; null: as it is."
    )
    tags: list[Tag] | None = Field(default=None, max_length=50, description="New tags; null: as they are.")


class MeasuredError(Resource):
    """A mean error, in its metric's unit, and its 95 % interval by blocks of frames; None where it is not known."""

    value: float = Field(description="Mean error, in its metric's unit.", json_schema_extra=UNIT_OF_METRIC)
    ci95: tuple[float, float] | None = Field(
        default=None,
        description="95 % interval, in the same unit; null where none can be given.",
        json_schema_extra=UNIT_OF_METRIC,
    )


class ComparedError(Resource):
    """One predictor's error on the held-out frames in two versions.

    ``gain``: mean of a − b over the frames that both versions score, paired, of b − a where a higher value is better;
    above zero: b is better. None where the
    versions were not scored on the same frames of the same recording.
    """

    metric: str = Field(description="Name of the metric.")
    predictor: str = Field(description="What predicted.")
    a: MeasuredError | None = Field(default=None, description="Error of the first version.")
    b: MeasuredError | None = Field(default=None, description="Error of the second.")
    gain: MeasuredError | None = Field(
        default=None, description="Paired gain of the second over the first; null: other frames."
    )


class Difference(Resource):
    """A fact in which two versions differ: its place (``config.steps``) and both values, None where one lacks it."""

    field: str = Field(description="Place of the fact.", examples=["config.steps"])
    a: Any = Field(default=None, description="Of the first version.")
    b: Any = Field(default=None, description="Of the second.")


class ErrorCurves(Resource):
    """Track error [m] of every predictor against the time in the recording [s], None where nothing was seen."""

    times_s: list[float] = Field(
        default_factory=list, description="Times in the recording.", json_schema_extra={"unit": "s"}
    )
    track_m: dict[str, list[float | None]] = Field(
        default_factory=dict,
        description="Track error by predictor; null where nothing was seen.",
        json_schema_extra={"unit": "m"},
    )


class ModelComparison(Resource):
    """Two versions of a name side by side."""

    name: str = Field(description="Name of the model.")
    a: int = Field(description="Number of the first version.")
    b: int = Field(description="Number of the second.")
    same_recording: bool = Field(description="Whether both were scored on the same frames.")
    errors: list[ComparedError] = Field(
        default_factory=list, description="Errors with intervals, by metric and predictor."
    )
    figures: list[Difference] = Field(default_factory=list, description="Speeds and times that differ.")
    curves_a: ErrorCurves = Field(default_factory=ErrorCurves, description="Curves of the first.")
    curves_b: ErrorCurves = Field(default_factory=ErrorCurves, description="Curves of the second.")
    differences: list[Difference] = Field(
        default_factory=list, description="What differs in how they were made."
    )
