"""World models: a name, integer versions that only grow, aliases that move."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, computed_field

from physworld_schemas.base import Artifact, Lineage, Request, Resource, Seed
from physworld_schemas.quality import Quality, quality_of

Format = Literal["torch_export", "onnx"]
FORMATS: tuple[Format, ...] = get_args(Format)
Tag = Annotated[str, Field(min_length=1, max_length=64)]


class TrainingConfig(Request):
    """Settings of the graph network (paper, section GNN-Based World Models) and of its training.

    The defaults are meant for some minutes on one core. ``patience``: validations without a better one after which
    the training ends (0: never). ``start_share`` below 1: the training may begin once that share of the dataset's
    episodes is committed, and takes the others in as it goes (``physworld.worldmodel.training``). ``prior``: what the
    network corrects; ``none``: it stands alone. ``frame``: the axes of a step, ``world``, ``grip`` (the grip's frame,
    where the scene has one) or ``auto``: what errs less on episodes that are not learned from. ``near_edges``:
    ``current`` finds the neighbours anew at every step, so that parts of the object that meet see each other.
    """

    hidden: int = Field(default=64, ge=8, le=1024)
    message_passing_steps: int = Field(default=7, ge=1, le=20)
    history: int = Field(default=3, ge=1, le=10)
    look_ahead: int = Field(default=24, ge=1, le=200)
    vertices: int = Field(default=100, ge=4, le=1000)
    steps: int = Field(default=240, ge=1, le=1_000_000)
    batch_size: int = Field(default=6, ge=1, le=256)
    learning_rate: float = Field(default=1e-3, gt=0, le=1)
    prior: Literal["auto", "modal", "chain", "none"] = "auto"
    frame: Literal["auto", "world", "grip"] = "auto"
    near_edges: Literal["material", "current"] = "material"
    patience: int = Field(default=8, ge=0, le=1000)
    start_share: float = Field(default=1.0, gt=0, le=1)
    fine_tune_steps: int = Field(default=60, ge=0, le=10_000)
    formats: list[Format] = Field(default_factory=lambda: [*FORMATS], max_length=2)
    seed: Seed = 0


class TrainingCreate(Request):
    """Body of POST /v1/models: trains on a sealed dataset and publishes the next version of ``name``."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$")
    dataset_id: str
    config: TrainingConfig = Field(default_factory=TrainingConfig)
    description: str = Field(default="", max_length=10_000)
    tags: list[Tag] = Field(default_factory=list, max_length=50)


class ModelVersion(Resource):
    """A published version; immutable once ready. ``sha256`` is the digest of its manifest.

    ``quality``: the verdict of the gate; a version that failed it stays ready and is never ``latest``.
    """

    name: str
    version: int
    state: Literal["pending", "ready", "failed"]
    message: str = ""
    created_at: datetime
    job_id: str | None = None
    scene_id: str | None = None
    fit_id: str | None = None
    trace_id: str | None = None
    dataset_id: str | None = None
    description: str = ""
    tags: list[str] = Field(default_factory=list)
    aliases: list[str] = Field(default_factory=list)
    config: TrainingConfig = Field(default_factory=TrainingConfig)
    metrics: dict[str, Any] = Field(default_factory=dict)
    sha256: str | None = None
    lineage: Lineage = Field(default_factory=Lineage)
    artifacts: list[Artifact] = Field(default_factory=list)

    @computed_field  # type: ignore[prop-decorator]  # pydantic's own advice
    @property
    def quality(self) -> Quality:
        """The verdict of the gate, from the metrics."""
        return quality_of(self.metrics)


class Model(Resource):
    """A registered name with its aliases.

    ``latest_version``: the newest number, whatever became of it; ``latest``: what that word stands for, the newest
    version that is ready and did not fail the quality gate.
    """

    name: str
    created_at: datetime
    latest_version: int | None = None
    latest: int | None = None
    aliases: dict[str, int] = Field(default_factory=dict)


class AliasSet(Request):
    """Body of PUT /v1/models/{name}/aliases/{alias}."""

    version: int = Field(ge=1, lt=2**31)


class VersionPatch(Request):
    """Body of PATCH /v1/models/{name}/versions/{version}: the two fields that are not part of what was published."""

    description: str | None = Field(default=None, max_length=10_000)
    tags: list[Tag] | None = Field(default=None, max_length=50)


class MeasuredError(Resource):
    """A mean error, in its metric's unit, and its 95 % interval by blocks of frames; None where it is not known."""

    value: float
    ci95: tuple[float, float] | None = None


class ComparedError(Resource):
    """One predictor's error on the held-out frames in two versions.

    ``gain``: mean of a − b over the frames that both versions score, paired, of b − a where a higher value is better;
    above zero: b is better. None where the
    versions were not scored on the same frames of the same recording.
    """

    metric: str
    predictor: str
    a: MeasuredError | None = None
    b: MeasuredError | None = None
    gain: MeasuredError | None = None


class Difference(Resource):
    """A fact in which two versions differ: its place (``config.steps``) and both values, None where one lacks it."""

    field: str
    a: Any = None
    b: Any = None


class ErrorCurves(Resource):
    """Track error [m] of every predictor against the time in the recording [s], None where nothing was seen."""

    times_s: list[float] = Field(default_factory=list)
    track_m: dict[str, list[float | None]] = Field(default_factory=dict)


class ModelComparison(Resource):
    """Two versions of a name side by side."""

    name: str
    a: int
    b: int
    same_recording: bool
    errors: list[ComparedError] = Field(default_factory=list)
    figures: list[Difference] = Field(default_factory=list)
    curves_a: ErrorCurves = Field(default_factory=ErrorCurves)
    curves_b: ErrorCurves = Field(default_factory=ErrorCurves)
    differences: list[Difference] = Field(default_factory=list)
