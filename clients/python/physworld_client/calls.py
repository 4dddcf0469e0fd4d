"""Every call of the REST API as plain data: method, path, query, body, and the type of the answer.

The synchronous and the asynchronous client send the same calls, so that an endpoint is written down once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, TypeAdapter

from physworld_client.bundle import Upload
from physworld_client.types import (
    ApiKey,
    Assessment,
    Check,
    Dataset,
    Episode,
    Fit,
    Job,
    Loop,
    Model,
    ModelComparison,
    ModelVersion,
    Scene,
    ScenePreview,
    SigningKey,
    Trace,
)
from physworld_schemas.assessment import AssessmentCreate
from physworld_schemas.base import Page
from physworld_schemas.check import CheckConfig, CheckCreate
from physworld_schemas.dataset import DatasetConfig, DatasetCreate
from physworld_schemas.fit import FitConfig, FitCreate
from physworld_schemas.key import KeyCreate, KeyRotate, Role
from physworld_schemas.loop import LoopCreate
from physworld_schemas.model import AliasSet, TrainingConfig, TrainingCreate, VersionPatch
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.scene import RecordingFacts, SceneImport, ScenePatch
from physworld_schemas.trace import TraceConfig, TraceCreate
from physworld_schemas.tracking import TrackingOptions, TrackingPreview

Answer = TypeVar("Answer")
Item = TypeVar("Item")


@dataclass(frozen=True)
class Call(Generic[Answer]):
    """One request and how to read its answer.

    Attributes:
        form: text beside an upload.
        read_timeout_s: seconds that the service may hold the answer back on purpose (long poll).
    """

    method: str
    path: str
    answer: TypeAdapter[Answer]
    query: Mapping[str, str | int | float] = field(default_factory=dict)
    body: BaseModel | None = None
    upload: Upload | None = None
    form: Mapping[str, str] = field(default_factory=dict)
    read_timeout_s: float = 0.0


ListCall = Callable[[str | None], Call[Page[Item]]]
"""A list from a cursor on."""

_SCENE = TypeAdapter(Scene)
_PREVIEW = TypeAdapter(ScenePreview)
_FIRST = TypeAdapter(TrackingPreview)
_KEY = TypeAdapter(ApiKey)
_KEYS = TypeAdapter(Page[ApiKey])
_FIT = TypeAdapter(Fit)
_CHECK = TypeAdapter(Check)
_TRACE = TypeAdapter(Trace)
_DATASET = TypeAdapter(Dataset)
_MODEL = TypeAdapter(Model)
_VERSION = TypeAdapter(ModelVersion)
_COMPARISON = TypeAdapter(ModelComparison)
_SIGNING_KEYS = TypeAdapter(Page[SigningKey])
_ASSESSMENT = TypeAdapter(Assessment)
_LOOP = TypeAdapter(Loop)
_LOOPS = TypeAdapter(Page[Loop])
_JOB = TypeAdapter(Job)
_SCENES = TypeAdapter(Page[Scene])
_FITS = TypeAdapter(Page[Fit])
_CHECKS = TypeAdapter(Page[Check])
_TRACES = TypeAdapter(Page[Trace])
_DATASETS = TypeAdapter(Page[Dataset])
_EPISODES = TypeAdapter(Page[Episode])
_MODELS = TypeAdapter(Page[Model])
_VERSIONS = TypeAdapter(Page[ModelVersion])
_ASSESSMENTS = TypeAdapter(Page[Assessment])
_JOBS = TypeAdapter(Page[Job])
BYTES = TypeAdapter(bytes)
"""An answer that is no JSON: its bytes as they are."""


def _given(**values: str | int | float | None) -> dict[str, str | int | float]:
    """A query without the parameters that were not given."""
    return {name: value for name, value in values.items() if value is not None}


def _part(text: str | int) -> str:
    """A path segment: an id or a name can never leave its place in the path."""
    return quote(str(text), safe="")


def scene_create(upload: Upload, options: SceneImport | None) -> Call[Scene]:
    """POST /v1/scenes, multipart fields ``bundle`` and ``options``."""
    return Call("POST", "/v1/scenes", _SCENE, upload=upload, form=_options(options))


def scene_preview(upload: Upload, options: SceneImport | None) -> Call[ScenePreview]:
    """POST /v1/scenes/preview, multipart fields ``bundle`` and ``options``."""
    return Call("POST", "/v1/scenes/preview", _PREVIEW, upload=upload, form=_options(options))


def _options(options: RecordingFacts | None) -> Mapping[str, str]:
    return {} if options is None else {"options": options.model_dump_json(exclude_unset=True)}


def tracking_create(upload: Upload, options: TrackingOptions | None) -> Call[Job]:
    """POST /v1/trackings, multipart fields ``bundle`` and ``options``."""
    return Call("POST", "/v1/trackings", _JOB, upload=upload, form=_options(options))


def tracking_preview(upload: Upload) -> Call[TrackingPreview]:
    """POST /v1/trackings/preview, multipart field ``bundle``."""
    return Call("POST", "/v1/trackings/preview", _FIRST, upload=upload)


def scene_get(scene_id: str) -> Call[Scene]:
    """GET /v1/scenes/{id}."""
    return Call("GET", f"/v1/scenes/{_part(scene_id)}", _SCENE)


def scene_patch(scene_id: str, tags: tuple[str, ...]) -> Call[Scene]:
    """PATCH /v1/scenes/{id}."""
    return Call("PATCH", f"/v1/scenes/{_part(scene_id)}", _SCENE, body=ScenePatch(tags=[*tags]))


def scene_list(
    *, limit: int | None, cursor: str | None, kind: str | None = None, tag: str | None = None
) -> Call[Page[Scene]]:
    """GET /v1/scenes; arguments as of :meth:`physworld_client.resources.Scenes.list`."""
    return Call("GET", "/v1/scenes", _SCENES, query=_given(limit=limit, cursor=cursor, kind=kind, tag=tag))


def fit_create(scene_id: str, config: FitConfig | None, scene_ids: Sequence[str] = ()) -> Call[Job]:
    """POST /v1/fits."""
    return Call(
        "POST",
        "/v1/fits",
        _JOB,
        body=FitCreate(scene_id=scene_id, scene_ids=list(scene_ids), config=config or FitConfig()),
    )


def fit_get(fit_id: str) -> Call[Fit]:
    """GET /v1/fits/{id}."""
    return Call("GET", f"/v1/fits/{_part(fit_id)}", _FIT)


def fit_list(*, limit: int | None, cursor: str | None, state: str | None = None) -> Call[Page[Fit]]:
    """GET /v1/fits."""
    return Call("GET", "/v1/fits", _FITS, query=_given(limit=limit, cursor=cursor, state=state))


def check_create(scene_id: str, config: CheckConfig | None) -> Call[Job]:
    """POST /v1/checks."""
    body = CheckCreate(scene_id=scene_id, config=config or CheckConfig())
    return Call("POST", "/v1/checks", _JOB, body=body)


def check_get(check_id: str) -> Call[Check]:
    """GET /v1/checks/{id}."""
    return Call("GET", f"/v1/checks/{_part(check_id)}", _CHECK)


def check_list(*, limit: int | None, cursor: str | None, scene_id: str | None = None) -> Call[Page[Check]]:
    """GET /v1/checks."""
    query = _given(limit=limit, cursor=cursor, scene_id=scene_id)
    return Call("GET", "/v1/checks", _CHECKS, query=query)


def trace_create(
    scene_id: str,
    config: TraceConfig | None,
    fit: FitConfig | None,
    fit_id: str | None,
    scene_ids: Sequence[str] = (),
    held_out_scene_ids: Sequence[str] = (),
) -> Call[Job]:
    """POST /v1/traces.

    Args:
        scene_id: the recording.
        config: settings; None has the defaults.
        fit: settings of the calibration that it begins with; None has the trace's defaults.
        fit_id: a ready fit whose twin to begin with, instead of a calibration.
        scene_ids: other recordings of the object, fitted with it.
        held_out_scene_ids: recordings that only the report sees.
    """
    body = TraceCreate(
        scene_id=scene_id,
        scene_ids=list(scene_ids),
        held_out_scene_ids=list(held_out_scene_ids),
        fit_id=fit_id,
        config=config or TraceConfig(),
    )
    return Call(
        "POST", "/v1/traces", _JOB, body=body if fit is None else body.model_copy(update={"fit": fit})
    )


def trace_get(trace_id: str) -> Call[Trace]:
    """GET /v1/traces/{id}."""
    return Call("GET", f"/v1/traces/{_part(trace_id)}", _TRACE)


def trace_list(
    *, limit: int | None, cursor: str | None, scene_id: str | None = None, verdict: str | None = None
) -> Call[Page[Trace]]:
    """GET /v1/traces.

    Args:
        limit: most traces of a page; None leaves it to the service.
        cursor: of the page before.
        scene_id: only traces of this scene.
        verdict: only traces with this answer.
    """
    query = _given(limit=limit, cursor=cursor, scene_id=scene_id, verdict=verdict)
    return Call("GET", "/v1/traces", _TRACES, query=query)


def trace_tracks(trace_id: str) -> Call[bytes]:
    """GET /v1/traces/{id}/tracks: an npz."""
    return Call("GET", f"/v1/traces/{_part(trace_id)}/tracks", BYTES)


def assessment_create(name: str, version: int | str, body: AssessmentCreate) -> Call[Job]:
    """POST /v1/models/{name}/versions/{version}/assessments."""
    path = f"/v1/models/{_part(name)}/versions/{_part(version)}/assessments"
    return Call("POST", path, _JOB, body=body)


def assessment_get(assessment_id: str) -> Call[Assessment]:
    """GET /v1/assessments/{id}."""
    return Call("GET", f"/v1/assessments/{_part(assessment_id)}", _ASSESSMENT)


def assessment_list(
    name: str | None, version: int | str | None, *, limit: int | None, cursor: str | None
) -> Call[Page[Assessment]]:
    """GET /v1/assessments, or /v1/models/{name}/versions/{version}/assessments.

    Args:
        name: of the model; None: of every model.
        version: its number, or an alias; None: every version.
        limit: most assessments of a page; None leaves it to the service.
        cursor: of the page before.
    """
    if name is None or version is None:
        query = _given(limit=limit, cursor=cursor, model=name)
        return Call("GET", "/v1/assessments", _ASSESSMENTS, query=query)
    path = f"/v1/models/{_part(name)}/versions/{_part(version)}/assessments"
    return Call("GET", path, _ASSESSMENTS, query=_given(limit=limit, cursor=cursor))


def loop_create(body: LoopCreate) -> Call[Job]:
    """POST /v1/loops."""
    return Call("POST", "/v1/loops", _JOB, body=body)


def loop_get(loop_id: str) -> Call[Loop]:
    """GET /v1/loops/{id}."""
    return Call("GET", f"/v1/loops/{_part(loop_id)}", _LOOP)


def loop_list(
    *, limit: int | None, cursor: str | None, model: str | None = None, state: str | None = None
) -> Call[Page[Loop]]:
    """GET /v1/loops.

    Args:
        limit: most loops of a page; None leaves it to the service.
        cursor: of the page before.
        model: only loops of this model.
        state: only loops in this state.
    """
    query = _given(limit=limit, cursor=cursor, model=model, state=state)
    return Call("GET", "/v1/loops", _LOOPS, query=query)


def dataset_create(fit_id: str, config: DatasetConfig | None, trace_id: str | None = None) -> Call[Job]:
    """POST /v1/datasets."""
    body = DatasetCreate(fit_id=fit_id, trace_id=trace_id, config=config or DatasetConfig())
    return Call("POST", "/v1/datasets", _JOB, body=body)


def dataset_get(dataset_id: str) -> Call[Dataset]:
    """GET /v1/datasets/{id}."""
    return Call("GET", f"/v1/datasets/{_part(dataset_id)}", _DATASET)


def dataset_list(*, limit: int | None, cursor: str | None, state: str | None = None) -> Call[Page[Dataset]]:
    """GET /v1/datasets."""
    return Call("GET", "/v1/datasets", _DATASETS, query=_given(limit=limit, cursor=cursor, state=state))


def dataset_episodes(dataset_id: str, *, limit: int | None, cursor: str | None) -> Call[Page[Episode]]:
    """GET /v1/datasets/{id}/episodes."""
    path = f"/v1/datasets/{_part(dataset_id)}/episodes"
    return Call("GET", path, _EPISODES, query=_given(limit=limit, cursor=cursor))


def dataset_episode(dataset_id: str, index: int) -> Call[bytes]:
    """GET /v1/datasets/{id}/episodes/{index}: an npz."""
    return Call("GET", f"/v1/datasets/{_part(dataset_id)}/episodes/{_part(index)}", BYTES)


def training_create(
    name: str, dataset_id: str, config: TrainingConfig | None, description: str, tags: list[str]
) -> Call[Job]:
    """POST /v1/models.

    Args:
        name: of the model.
        dataset_id: a dataset, sealed or still being written.
        config: settings; None has the defaults.
        description: of the version, for people.
        tags: likewise.
    """
    body = TrainingCreate(
        name=name,
        dataset_id=dataset_id,
        config=config or TrainingConfig(),
        description=description,
        tags=tags,
    )
    return Call("POST", "/v1/models", _JOB, body=body)


def model_get(name: str) -> Call[Model]:
    """GET /v1/models/{name}."""
    return Call("GET", f"/v1/models/{_part(name)}", _MODEL)


def model_list(*, limit: int | None, cursor: str | None) -> Call[Page[Model]]:
    """GET /v1/models."""
    return Call("GET", "/v1/models", _MODELS, query=_given(limit=limit, cursor=cursor))


def version_get(name: str, version: int | str) -> Call[ModelVersion]:
    """GET /v1/models/{name}/versions/{version}: a number, an alias or ``latest``."""
    return Call("GET", f"/v1/models/{_part(name)}/versions/{_part(version)}", _VERSION)


def version_list(name: str, *, limit: int | None, cursor: str | None) -> Call[Page[ModelVersion]]:
    """GET /v1/models/{name}/versions."""
    path = f"/v1/models/{_part(name)}/versions"
    return Call("GET", path, _VERSIONS, query=_given(limit=limit, cursor=cursor))


def alias_set(name: str, alias: str, version: int) -> Call[Model]:
    """PUT /v1/models/{name}/aliases/{alias}."""
    path = f"/v1/models/{_part(name)}/aliases/{_part(alias)}"
    return Call("PUT", path, _MODEL, body=AliasSet(version=version))


def alias_delete(name: str, alias: str) -> Call[Model]:
    """DELETE /v1/models/{name}/aliases/{alias}."""
    return Call("DELETE", f"/v1/models/{_part(name)}/aliases/{_part(alias)}", _MODEL)


def version_patch(
    name: str, version: int | str, description: str | None, tags: tuple[str, ...] | None
) -> Call[ModelVersion]:
    """PATCH /v1/models/{name}/versions/{version}.

    Args:
        name: of the model.
        version: its number, or an alias.
        description: the new one; None leaves it.
        tags: the new ones; None leaves them.
    """
    body = VersionPatch(description=description, tags=None if tags is None else [*tags])
    return Call("PATCH", f"/v1/models/{_part(name)}/versions/{_part(version)}", _VERSION, body=body)


def versions_compare(name: str, a: int | str, b: int | str) -> Call[ModelComparison]:
    """GET /v1/models/{name}/compare."""
    return Call("GET", f"/v1/models/{_part(name)}/compare", _COMPARISON, query={"a": str(a), "b": str(b)})


def signing_keys() -> Call[Page[SigningKey]]:
    """GET /v1/signing-keys."""
    return Call("GET", "/v1/signing-keys", _SIGNING_KEYS, query={"limit": 200})


def key_create(name: str, role: Role, expires_in_days: int | None) -> Call[ApiKey]:
    """POST /v1/keys."""
    body = KeyCreate(name=name, role=role, expires_in_days=expires_in_days)
    return Call("POST", "/v1/keys", _KEY, body=body)


def key_list(*, limit: int | None, cursor: str | None) -> Call[Page[ApiKey]]:
    """GET /v1/keys."""
    return Call("GET", "/v1/keys", _KEYS, query=_given(limit=limit, cursor=cursor))


def key_rotate(key_id: str, grace_minutes: int | None) -> Call[ApiKey]:
    """POST /v1/keys/{id}/rotate."""
    body = KeyRotate() if grace_minutes is None else KeyRotate(grace_minutes=grace_minutes)
    return Call("POST", f"/v1/keys/{_part(key_id)}/rotate", _KEY, body=body)


def key_revoke(key_id: str) -> Call[ApiKey]:
    """DELETE /v1/keys/{id}."""
    return Call("DELETE", f"/v1/keys/{_part(key_id)}", _KEY)


def pipeline_create(body: PipelineCreate) -> Call[Job]:
    """POST /v1/pipelines."""
    return Call("POST", "/v1/pipelines", _JOB, body=body)


def pipeline_body(body: PipelineCreate | None, scene_id: str | None) -> PipelineCreate:
    """The body given, or the one with the defaults for a scene; exactly one of the two must be given."""
    if body is None and scene_id is not None:
        return PipelineCreate(scene_id=scene_id)
    if body is not None and scene_id is None:
        return body
    raise TypeError("pipelines.create takes either a PipelineCreate or scene_id")


def job_get(job_id: str, *, wait_s: float | None = None) -> Call[Job]:
    """GET /v1/jobs/{id}; with ``wait_s`` the service answers at the job's end or after that many seconds."""
    query = _given(wait=wait_s)
    return Call("GET", f"/v1/jobs/{_part(job_id)}", _JOB, query=query, read_timeout_s=wait_s or 0.0)


def job_list(
    *, limit: int | None, cursor: str | None, state: str | None = None, kind: str | None = None
) -> Call[Page[Job]]:
    """GET /v1/jobs.

    Args:
        limit: most jobs of a page; None leaves it to the service.
        cursor: of the page before.
        state: only jobs of this state.
        kind: only jobs of this kind.
    """
    return Call("GET", "/v1/jobs", _JOBS, query=_given(limit=limit, cursor=cursor, state=state, kind=kind))


def job_retry(job_id: str) -> Call[Job]:
    """POST /v1/jobs/{id}/retry."""
    return Call("POST", f"/v1/jobs/{_part(job_id)}/retry", _JOB)


def job_cancel(job_id: str) -> Call[Job]:
    """POST /v1/jobs/{id}/cancel."""
    return Call("POST", f"/v1/jobs/{_part(job_id)}/cancel", _JOB)


def events_path(job_id: str) -> str:
    """GET /v1/jobs/{id}/events, server-sent events."""
    return f"/v1/jobs/{_part(job_id)}/events"


def artifact_path(sha256: str) -> str:
    """GET /v1/artifacts/{sha256}."""
    return f"/v1/artifacts/{_part(sha256)}"
