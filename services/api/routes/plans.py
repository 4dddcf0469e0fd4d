"""Plans: motions of the grips that bring the object to a goal, checked in the twin."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from sqlalchemy.orm import Session

from physworld_schemas.arrays import FARTHEST_M, EncodedArray
from physworld_schemas.base import Page
from physworld_schemas.job import Job
from physworld_schemas.plan import Plan, PlanCreate, ShapeGoal
from physworld_services.api.bodies import LongBodyRoute
from physworld_services.api.dependencies import DatabaseDep, ObjectId, PageDep, StoresDep
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import IdempotencyDep, accepted
from physworld_services.api.routes.rollouts import invalid, read_array, ready_version
from physworld_services.stores import Stores
from physworld_storage import registry, resources, runs
from physworld_storage.database import Database
from physworld_storage.jobs import jobs

router = APIRouter(prefix="/plans", tags=["plans"], route_class=LongBodyRoute)

MOST_SHAPE_POINTS = 20_000


@router.post("", status_code=202, response_model=Job, responses=documented(401, 403, 404, 409, 413, 422))
def create_plan(
    body: PlanCreate, idempotency: IdempotencyDep, database: DatabaseDep, stores: StoresDep
) -> Response:
    """Search a motion that brings the object to the goal; the plan's id is in the job's `outputs`."""
    opening = plan_opening(body, database, stores)
    return idempotency.run(body, lambda session: accepted(opening(session)))


@router.get("", responses=documented(401, 403, 422))
def list_plans(
    database: DatabaseDep, page: PageDep, model: Annotated[str | None, Query(max_length=64)] = None
) -> Page[Plan]:
    """Plans, newest first."""
    with database.reading() as session:
        return runs.list_plans(session, limit=page.limit, cursor=page.cursor, model=model)


@router.get("/{plan_id}", responses=documented(401, 403, 404, 422))
def get_plan(plan_id: ObjectId, database: DatabaseDep) -> Plan:
    """A plan; control path, predicted and executed paths are the artifact `plan.npz`."""
    with database.reading() as session:
        return runs.get_plan(session, plan_id)


def plan_opening(
    body: PlanCreate, database: Database, stores: Stores, made_of: Mapping[str, Any] | None = None
) -> Callable[[Session], Job]:
    """What opens the plan's job, its request checked and stored. Raises ApiProblem, 409 or 422.

    Args:
        body: of the request.
        database, stores: of the installation.
        made_of: what the goal of the body was made of, kept among the job's settings.
    """
    with database.reading() as session:
        version = ready_version(registry.get_version(session, body.model, body.version))
        points = resources.get_scene(session, str(version.scene_id)).points
    asked = _checked(body, points).model_copy(update={"version": version.version})
    request = stores.artifacts.put_bytes(asked.model_dump_json().encode(), runs.REQUEST, "application/json")
    config = asked.model_dump(mode="json", exclude={"goal"}) | {"goal": body.goal.kind}
    config |= made_of or {}
    return lambda session: jobs.create_run(
        session, "plan", body.model, version.version, config, request, body.config.iterations
    )


def _checked(body: PlanCreate, points: int) -> PlanCreate:
    """The request with its goal's array checked. Raises ApiProblem, 422."""
    if isinstance(body.goal, ShapeGoal):
        shape = read_array(body.goal.shape, "goal.shape", (2,), FARTHEST_M)
        if shape.shape[1] != 3 or len(shape) > MOST_SHAPE_POINTS:
            raise invalid("goal.shape", f"goal.shape is {shape.shape}, not (M <= {MOST_SHAPE_POINTS}, 3)")
        return body.model_copy(update={"goal": ShapeGoal(kind="shape", shape=EncodedArray.of(shape))})
    beyond = [index for index in body.goal.index if index >= points]
    if beyond:
        raise invalid("goal.index", f"goal.index holds {beyond[:5]}; the scene has {points} points")
    return body
