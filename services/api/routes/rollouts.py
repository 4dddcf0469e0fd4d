"""Rollouts: what a published model predicts for control paths, at once or as a job."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Response
from sqlalchemy.orm import Session

from physworld.arrays import Array
from physworld_schemas.arrays import FARTHEST_M, ArrayInput, EncodedArray, array_of
from physworld_schemas.base import FieldError, Page
from physworld_schemas.job import Job
from physworld_schemas.model import ModelVersion
from physworld_schemas.rollout import (
    MAX_CANDIDATES,
    MAX_LOG_RATIO,
    MAX_STEPS,
    MAX_TICKS,
    SYNC_STEPS,
    SYNC_VALUES,
    Predictor,
    Rollout,
    RolloutCreate,
)
from physworld_services.api.bodies import LongBodyRoute
from physworld_services.api.dependencies import (
    DatabaseDep,
    ObjectId,
    PageDep,
    PrincipalDep,
    SettingsDep,
    StoresDep,
)
from physworld_services.api.errors import ApiProblem, documented
from physworld_services.api.idempotency import IdempotencyDep, accepted, answer_of
from physworld_services.api.inference import roll_out
from physworld_services.stores import Stores
from physworld_storage import registry, resources, runs
from physworld_storage.database import Database
from physworld_storage.jobs import jobs

router = APIRouter(prefix="/rollouts", tags=["rollouts"], route_class=LongBodyRoute)

NOMINAL_RATE_HZ, LEAST_RATE_HZ = 30.0, 22.5
"""Ticks of a model's clock in a second: near so many, and never fewer (``physworld.worldmodel.clock.model_dt``)."""
_ANSWERS: dict[int | str, dict[str, Any]] = {
    202: {"description": "Too large to be answered at once: a job; its output is the rollout"},
    **documented(401, 403, 404, 409, 413, 422, 503),
}


@router.post("", response_model=Rollout, responses=_ANSWERS)
def create_rollout(
    body: RolloutCreate,
    idempotency: IdempotencyDep,
    database: DatabaseDep,
    stores: StoresDep,
    settings: SettingsDep,
    principal: PrincipalDep,
) -> Response:
    """Predict a batch of control paths: 200 with the arrays for a small one, 202 with a job for a large one, or for
    one by the twin."""
    with database.reading() as session:
        version = ready_version(registry.get_version(session, body.model, body.version))
        scene = resources.get_scene(session, str(version.scene_id))
    shape = _shape(body, scene.controllers)
    asked = _encoded(body).model_copy(update={"version": version.version, "by": _predictor(body, version)})
    ticks = _ticks(body, shape)
    places = sum(
        {"points": scene.points, "vertices": version.config.vertices}[part] for part in set(body.returns)
    )
    small = shape[0] * ticks <= SYNC_STEPS and 3 * shape[0] * -(-ticks // body.every) * places <= SYNC_VALUES
    if small and body.mode == "auto" and asked.by == "model" and settings.inference_url:
        found = roll_out(settings.inference_url, database, principal.credential, asked)
        return idempotency.run(body, lambda session: answer_of(200, found))
    opening = _opening(asked, shape, ticks, version.version, stores)
    return idempotency.run(body, lambda session: accepted(opening(session)))


@router.get("", responses=documented(401, 403, 422))
def list_rollouts(
    database: DatabaseDep, page: PageDep, model: Annotated[str | None, Query(max_length=64)] = None
) -> Page[Rollout]:
    """Rollouts that were jobs, newest first."""
    with database.reading() as session:
        return runs.list_rollouts(session, limit=page.limit, cursor=page.cursor, model=model)


@router.get("/{rollout_id}", responses=documented(401, 403, 404, 422))
def get_rollout(rollout_id: ObjectId, database: DatabaseDep) -> Rollout:
    """A rollout that was a job; its arrays are the artifact `rollout.npz`."""
    with database.reading() as session:
        return runs.get_rollout(session, rollout_id)


def rollout_opening(
    body: RolloutCreate, database: Database, stores: Stores, made_of: Mapping[str, Any] | None = None
) -> Callable[[Session], Job]:
    """What opens the rollout's job, its request checked and stored. Raises ApiProblem, 409 or 422.

    Args:
        body: of the request.
        database, stores: of the installation.
        made_of: what the arrays of the body were made of, kept among the job's settings.
    """
    with database.reading() as session:
        version = ready_version(registry.get_version(session, body.model, body.version))
        scene = resources.get_scene(session, str(version.scene_id))
    shape = _shape(body, scene.controllers)
    asked = _encoded(body).model_copy(update={"version": version.version, "by": _predictor(body, version)})
    return _opening(asked, shape, _ticks(body, shape), version.version, stores, made_of)


def _ticks(body: RolloutCreate, shape: tuple[int, int]) -> int:
    return shape[1] if body.times is None else max(1, round(body.times[-1] * NOMINAL_RATE_HZ))


def _opening(
    asked: RolloutCreate,
    shape: tuple[int, int],
    ticks: int,
    version: int,
    stores: Stores,
    made_of: Mapping[str, Any] | None = None,
) -> Callable[[Session], Job]:
    request = stores.artifacts.put_bytes(asked.model_dump_json().encode(), runs.REQUEST, "application/json")
    config = asked.model_dump(mode="json", exclude={"controllers", "phi", "times"}) | {"shape": list(shape)}
    config |= made_of or {}
    return lambda session: jobs.create_run(
        session, "rollout", asked.model, version, config, request, shape[0] * ticks
    )


def ready_version(version: ModelVersion) -> ModelVersion:
    """The version, if it can predict. Raises ApiProblem, 409."""
    if version.state != "ready" or version.scene_id is None:
        raise ApiProblem(
            409,
            "conflict",
            f"version {version.version} of {version.name} is {version.state}; it cannot predict",
        )
    return version


def _predictor(body: RolloutCreate, version: ModelVersion) -> Predictor:
    """Who answers: as is asked, else as the version says. Raises ApiProblem, 422, for a twin that there is not."""
    if body.by == "twin" and version.fit_id is None:
        raise invalid(
            "by", f"version {version.version} of {version.name} learned from no twin of this service"
        )
    if body.by is not None:
        return body.by
    prefers_twin = version.metrics.get("predictor") == "twin" and version.fit_id is not None
    return "twin" if prefers_twin and body.phi is None else "model"


def invalid(field: str, message: str) -> ApiProblem:
    """422 that names the field."""
    return ApiProblem(422, "invalid_request", message, errors=[FieldError(loc=["body", field], msg=message)])


def read_array(value: ArrayInput, field: str, dimensions: tuple[int, ...], most: float) -> Array:
    """The values, finite and within ±``most``.

    Args:
        value: as it was sent.
        field: its name in the request.
        dimensions: the numbers of axes that it may have.
        most: largest absolute value.

    Raises:
        ApiProblem: 422, with the place and the numbers.
    """
    try:
        return array_of(value, field, dimensions, most)
    except ValueError as error:
        raise invalid(field, str(error)) from error


def _shape(body: RolloutCreate, controllers: int) -> tuple[int, int]:
    """(B, T) of the control paths, after everything that needs no model was checked."""
    values = read_array(body.controllers, "controllers", (3, 4), FARTHEST_M)
    shape = values.shape if values.ndim == 4 else (1, *values.shape)
    if shape[2:] != (controllers, 3):
        raise invalid(
            "controllers",
            f"controllers of shape {values.shape}, not (B, T, {controllers}, 3): the scene has {controllers} of them",
        )
    if (
        shape[0] > MAX_CANDIDATES
        or shape[0] * shape[1] > MAX_STEPS
        or (body.times is None and shape[1] > MAX_TICKS)
    ):
        raise invalid(
            "controllers",
            f"{shape[0]} candidates of {shape[1]} ticks; at most {MAX_CANDIDATES} candidates, {MAX_TICKS} ticks and "
            f"{MAX_STEPS} in all",
        )
    if body.times is not None:
        _check_times(body.times, shape[0], shape[1])
    return shape[0], shape[1]


def _check_times(times: list[float], candidates: int, places: int) -> None:
    """Raises ApiProblem for times that are not numbers, not as many as places, or too long for any model's clock."""
    if not times or not np.isfinite(times).all() or len(times) != places:
        raise invalid("times", f"{len(times)} times, which must be finite, for {places} places")
    ticks = times[-1] * LEAST_RATE_HZ
    if ticks > MAX_TICKS or candidates * ticks > MAX_STEPS:
        raise invalid(
            "times",
            f"times end at {times[-1]:.4g} s: {candidates} candidates of {ticks:.4g} ticks or more; at most "
            f"{MAX_TICKS} ticks and {MAX_STEPS} in all",
        )


def _encoded(body: RolloutCreate) -> RolloutCreate:
    """The same with its arrays in single precision."""
    arrays = {"controllers": EncodedArray.of(read_array(body.controllers, "controllers", (3, 4), FARTHEST_M))}
    if body.phi is not None:
        arrays["phi"] = EncodedArray.of(read_array(body.phi, "phi", (2, 3), MAX_LOG_RATIO))
    return body.model_copy(update=arrays)
