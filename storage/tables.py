"""The database's tables. Rows are private to ``storage``; everybody else sees the models of ``schemas``.

Times are UTC with microseconds. A JSON column is replaced, never changed in place. The state machine lives
in ``jobs`` and ``shards``; ``fits``, ``datasets`` and ``model_versions`` are what a job brings forth.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, ClassVar

from sqlalchemy import (
    JSON,
    BigInteger,
    DateTime,
    Dialect,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    UniqueConstraint,
    inspect,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column
from sqlalchemy.types import TypeDecorator

Json = dict[str, Any]
JsonList = list[Any]

BIG_KEY = BigInteger().with_variant(Integer, "sqlite")  # SQLite allots only keys declared INTEGER


def utc_now() -> datetime:
    """The present time, aware, in UTC."""
    return datetime.now(UTC)


class UtcDateTime(TypeDecorator[datetime]):
    """An aware UTC time on every database (SQLite itself keeps no time zone)."""

    impl = DateTime(timezone=True)
    cache_ok = True

    @property
    def python_type(self) -> type[datetime]:
        """What a value is in Python; ``physworld_storage.pages`` reads cursors by it."""
        return datetime

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Refuse a naive time: nobody could say which hour it means."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"naive time {value.isoformat()}: pass an aware one, e.g. tables.utc_now()")
        return value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Attach UTC where the database gave back a naive time."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class Base(DeclarativeBase):
    """Names of constraints are fixed so that migrations can speak of them.

    Attributes:
        noun: what one row is called, where rows are asked for by their id.
    """

    noun: ClassVar[str]
    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {datetime: UtcDateTime, Json: JSON, JsonList: JSON}  # noqa: RUF012 (SQLAlchemy's name)


def columns_of(row: Base, without: str = "") -> Json:
    """The row's values by column name, as the wire models read them; ``without`` names one that is not loaded."""
    columns = (column.key for column in inspect(type(row)).column_attrs)
    return {key: getattr(row, key) for key in columns if key != without}


def insert_if_absent(session: Session, table: type[Base], values: Json) -> bool:
    """Insert a row unless its key or a unique column is taken; True when it was inserted.

    On Postgres it waits for another transaction that is inserting the same key.
    """
    dialect = session.get_bind().dialect.name
    insert = postgresql.insert if dialect == "postgresql" else sqlite.insert
    statement = insert(table).values(values).on_conflict_do_nothing()
    # Without the option SQLAlchemy does not ask psycopg how many rows an INSERT made.
    kept = statement.execution_options(preserve_rowcount=True)
    return session.connection().execute(kept).rowcount == 1


class SceneRow(Base):
    """A measured recording; its arrays are an artifact."""

    __tablename__ = "scenes"
    noun = "scene"

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    kind: Mapped[str]
    description: Mapped[str]
    created_at: Mapped[datetime]
    digest: Mapped[str] = mapped_column(unique=True)
    frames: Mapped[int]
    points: Mapped[int]
    controllers: Mapped[int]
    fps: Mapped[float]
    duration_s: Mapped[float]
    noise_sigma_m: Mapped[float | None]
    train: Mapped[JsonList]
    test: Mapped[JsonList]
    declared: Mapped[Json]
    warnings: Mapped[JsonList]
    artifacts: Mapped[JsonList]
    tags: Mapped[JsonList]


class JobRow(Base):
    """A piece of work; ``stage_done`` of ``stage_total`` shards of stage ``stage`` are done.

    ``pace`` says how it goes in time (``physworld_storage.jobs.pace``).
    """

    __tablename__ = "jobs"
    noun = "job"
    __table_args__ = (
        Index(None, "state"),
        Index(None, "created_at"),
        Index(None, "kind", "state", "created_at"),
    )

    id: Mapped[str] = mapped_column(primary_key=True)
    kind: Mapped[str]
    state: Mapped[str]
    parent_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id"), index=True)
    stage: Mapped[int] = mapped_column(default=0)
    stage_total: Mapped[int] = mapped_column(default=0)
    stage_done: Mapped[int] = mapped_column(default=0)
    attempt: Mapped[int] = mapped_column(default=0)
    progress: Mapped[Json]
    created_at: Mapped[datetime]
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    heartbeat_at: Mapped[datetime | None]
    inputs: Mapped[JsonList]
    outputs: Mapped[JsonList]
    config: Mapped[Json]
    error: Mapped[Json | None] = mapped_column(JSON(none_as_null=True))
    pace: Mapped[Json | None] = mapped_column(JSON(none_as_null=True))


class ShardRow(Base):
    """One unit that a worker executes under a lease; ``epoch`` is the fencing token, it only grows.

    ``attempt`` counts claims, ``failures`` those that failed; ``losses`` are those that were lost since the shard last
    got on (``physworld_storage.jobs.losses``), ``claimed_at``, ``renewed_at`` and ``progress`` say where the present
    attempt is.
    """

    __tablename__ = "shards"
    __table_args__ = (
        UniqueConstraint("job_id", "stage", "index"),
        Index(None, "state", "kind", "published_at"),
        Index(None, "state", "lease_until"),
    )

    id: Mapped[str] = mapped_column(primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"))
    stage: Mapped[int]
    index: Mapped[int]
    kind: Mapped[str]
    state: Mapped[str]
    attempt: Mapped[int] = mapped_column(default=0)
    max_attempts: Mapped[int]
    failures: Mapped[int] = mapped_column(default=0, server_default="0")
    epoch: Mapped[int] = mapped_column(default=0)
    claimed_at: Mapped[datetime | None]
    renewed_at: Mapped[datetime | None]
    progress: Mapped[Json | None] = mapped_column(JSON(none_as_null=True))
    losses: Mapped[JsonList | None] = mapped_column(JSON(none_as_null=True))
    lease_owner: Mapped[str | None]
    lease_until: Mapped[datetime | None]
    created_at: Mapped[datetime]
    published_at: Mapped[datetime | None]
    not_before: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    payload: Mapped[Json]
    result: Mapped[Json | None] = mapped_column(JSON(none_as_null=True))
    digest: Mapped[str | None]
    error: Mapped[Json | None] = mapped_column(JSON(none_as_null=True))


class EventRow(Base):
    """The log of all jobs; ``seq`` is never used twice."""

    __tablename__ = "events"
    __table_args__ = (Index(None, "job_id", "seq"), {"sqlite_autoincrement": True})

    seq: Mapped[int] = mapped_column(BIG_KEY, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"))
    type: Mapped[str]
    at: Mapped[datetime]
    data: Mapped[Json]


class Made(Base):
    """What a job brings forth: pending until the last shard of the job is committed."""

    __abstract__ = True

    id: Mapped[str] = mapped_column(primary_key=True)
    state: Mapped[str]
    created_at: Mapped[datetime]
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"))
    config: Mapped[Json]
    lineage: Mapped[Json]


class FitRow(Made):
    """A calibrated twin."""

    __tablename__ = "fits"
    noun = "fit"
    __table_args__ = (Index(None, "created_at"),)

    scene_id: Mapped[str] = mapped_column(ForeignKey("scenes.id"), index=True)
    parameters: Mapped[Json]
    metrics: Mapped[Json]
    artifacts: Mapped[JsonList]


class TraceRow(Made):
    """A residual traced to an effect; ``report`` is the whole answer, beginning with the other recordings asked for."""

    __tablename__ = "traces"
    noun = "trace"
    __table_args__ = (Index(None, "created_at"),)

    scene_id: Mapped[str] = mapped_column(ForeignKey("scenes.id"), index=True)
    fit_id: Mapped[str | None] = mapped_column(ForeignKey("fits.id"))
    fit: Mapped[Json]
    verdict: Mapped[str | None]
    report: Mapped[Json]
    artifacts: Mapped[JsonList]


class CheckRow(Made):
    """What a scene's motion can show; ``report`` is the whole answer."""

    __tablename__ = "checks"
    noun = "check"
    __table_args__ = (Index(None, "created_at"),)

    scene_id: Mapped[str] = mapped_column(ForeignKey("scenes.id"), index=True)
    report: Mapped[Json | None]


class VideoRow(Made):
    """A film of a motion; ``report`` says what was drawn."""

    __tablename__ = "videos"
    noun = "video"
    __table_args__ = (Index(None, "created_at"), Index(None, "of", "source_id"))

    of: Mapped[str]
    source_id: Mapped[str]
    scene_id: Mapped[str] = mapped_column(ForeignKey("scenes.id"), index=True)
    report: Mapped[Json | None]
    artifacts: Mapped[JsonList]


class DatasetRow(Made):
    """A set of episodes, immutable once sealed."""

    __tablename__ = "datasets"
    noun = "dataset"
    __table_args__ = (Index(None, "created_at"),)

    fit_id: Mapped[str] = mapped_column(ForeignKey("fits.id"), index=True)
    trace_id: Mapped[str | None]
    scene_id: Mapped[str] = mapped_column(ForeignKey("scenes.id"), index=True)
    episodes_done: Mapped[int] = mapped_column(default=0)
    digest: Mapped[str | None]
    statistics: Mapped[Json]
    artifacts: Mapped[JsonList]


class EpisodeRow(Base):
    """A committed episode; the primary key is what makes a second commit of the same one impossible."""

    __tablename__ = "episodes"

    dataset_id: Mapped[str] = mapped_column(ForeignKey("datasets.id"), primary_key=True)
    index: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    shard_id: Mapped[str] = mapped_column(ForeignKey("shards.id"), unique=True)
    path: Mapped[str] = mapped_column(unique=True)
    digest: Mapped[str]
    seed: Mapped[int] = mapped_column(BigInteger)
    frames: Mapped[int]
    particles: Mapped[int]
    attempt: Mapped[int]
    motion: Mapped[str]
    seconds: Mapped[float | None]
    created_at: Mapped[datetime]


class ModelRow(Base):
    """A registered name; ``last_version`` is the counter that versions are allotted from."""

    __tablename__ = "models"

    name: Mapped[str] = mapped_column(primary_key=True)
    created_at: Mapped[datetime]
    last_version: Mapped[int] = mapped_column(default=0)


class ModelVersionRow(Base):
    """One version of a model, immutable once ready."""

    __tablename__ = "model_versions"

    name: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    version: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    state: Mapped[str]
    message: Mapped[str]
    created_at: Mapped[datetime]
    job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id"), index=True)
    scene_id: Mapped[str | None] = mapped_column(ForeignKey("scenes.id"))
    fit_id: Mapped[str | None] = mapped_column(ForeignKey("fits.id"))
    trace_id: Mapped[str | None]
    dataset_id: Mapped[str | None] = mapped_column(ForeignKey("datasets.id"))
    description: Mapped[str]
    tags: Mapped[JsonList]
    config: Mapped[Json]
    metrics: Mapped[Json]
    sha256: Mapped[str | None]
    lineage: Mapped[Json]
    artifacts: Mapped[JsonList]


class AliasRow(Base):
    """A movable name of a version."""

    __tablename__ = "aliases"
    __table_args__ = (
        ForeignKeyConstraint(["name", "version"], ["model_versions.name", "model_versions.version"]),
    )

    name: Mapped[str] = mapped_column(primary_key=True)
    alias: Mapped[str] = mapped_column(primary_key=True)
    version: Mapped[int]
    updated_at: Mapped[datetime]


class AssessmentRow(Made):
    """A new recording held against a model version; ``figures`` is the answer."""

    __tablename__ = "assessments"
    noun = "assessment"
    __table_args__ = (
        ForeignKeyConstraint(["name", "version"], ["model_versions.name", "model_versions.version"]),
        Index(None, "name", "version", "created_at"),
    )

    name: Mapped[str]
    version: Mapped[int]
    scene_id: Mapped[str] = mapped_column(ForeignKey("scenes.id"))
    figures: Mapped[Json]
    trace_id: Mapped[str | None]


class SigningKeyRow(Base):
    """A public key that signs manifests; the private one is never here."""

    __tablename__ = "signing_keys"

    key_id: Mapped[str] = mapped_column(primary_key=True)
    public_key: Mapped[str]
    created_at: Mapped[datetime]


class ApiKeyRow(Base):
    """An API key: the SHA-256 of its token, never the token."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    role: Mapped[str]
    digest: Mapped[str] = mapped_column(unique=True)
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime | None]
    lifetime_days: Mapped[int | None]
    revoked_at: Mapped[datetime | None]


class RetiredTokenRow(Base):
    """A token that a key had before a rotation: its SHA-256, good until ``valid_until`` and remembered for ever."""

    __tablename__ = "retired_tokens"

    digest: Mapped[str] = mapped_column(primary_key=True)
    key_id: Mapped[str] = mapped_column(ForeignKey("api_keys.id"), index=True)
    valid_until: Mapped[datetime]


class SessionRow(Base):
    """A browser's session: the SHA-256 of the text in its cookie, never the text."""

    __tablename__ = "sessions"

    digest: Mapped[str] = mapped_column(primary_key=True)
    key_id: Mapped[str] = mapped_column(ForeignKey("api_keys.id"), index=True)
    address: Mapped[str | None]
    created_at: Mapped[datetime]
    seen_at: Mapped[datetime]
    expires_at: Mapped[datetime]


class AuditRow(Base):
    """One change that matters to security; rows are added, never changed. ``seq`` is never used twice."""

    __tablename__ = "audit"
    __table_args__ = ({"sqlite_autoincrement": True},)

    seq: Mapped[int] = mapped_column(BIG_KEY, primary_key=True, autoincrement=True)
    at: Mapped[datetime]
    actor: Mapped[str | None]
    address: Mapped[str | None]
    action: Mapped[str]
    subject: Mapped[str | None]
    detail: Mapped[Json]


class IdempotencyRow(Base):
    """The first answer given to an Idempotency-Key; ``owner`` is the API key's id."""

    __tablename__ = "idempotency_keys"
    __table_args__ = (Index(None, "created_at"),)

    owner: Mapped[str] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(primary_key=True)
    fingerprint: Mapped[str]
    created_at: Mapped[datetime]
    status: Mapped[int | None]
    headers: Mapped[Json | None] = mapped_column(JSON(none_as_null=True))
    body: Mapped[bytes | None] = mapped_column(LargeBinary)


class RunRow(Made):
    """A rollout or a plan made with a model version; ``figures`` is the answer beside its artifacts."""

    __tablename__ = "model_runs"
    noun = "run"
    __table_args__ = (
        ForeignKeyConstraint(["model", "version"], ["model_versions.name", "model_versions.version"]),
        Index(None, "kind", "created_at"),
    )

    kind: Mapped[str]
    model: Mapped[str]
    version: Mapped[int]
    figures: Mapped[Json]
    artifacts: Mapped[JsonList]


class TicketRow(Base):
    """A ticket that lets one connection in where no header can be sent: the SHA-256 of its text, never the text.

    ``credential`` is that of the request which asked for it: the ticket and what it opens end with it.
    """

    __tablename__ = "tickets"
    __table_args__ = (Index(None, "expires_at"),)

    digest: Mapped[str] = mapped_column(primary_key=True)
    credential: Mapped[str]
    subject: Mapped[str]
    expires_at: Mapped[datetime]
