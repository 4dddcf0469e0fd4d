"""Deletions: an object goes when nothing was made from it; files that nobody names follow within a day."""

from __future__ import annotations

from fastapi import APIRouter, Response

from physworld_services.api.dependencies import ActorDep, DatabaseDep, ModelName, ObjectId, StoresDep
from physworld_services.api.errors import documented
from physworld_services.api.routes.models import Version
from physworld_services.stores import Stores
from physworld_storage import registry, removal
from physworld_storage.access import audit
from physworld_storage.access.audit import Actor
from physworld_storage.database import Database

router = APIRouter(responses=documented(401, 403, 404, 409, 422))


def delete_object(database: Database, actor: Actor, kind: str, object_id: str) -> Response:
    """Delete, leave a line in the audit log, and answer 204."""
    with database.session() as session:
        removal.remove(session, kind, object_id)
        audit.record(session, actor, f"{kind}.deleted", object_id)
    return Response(status_code=204)


def delete_episodes(database: Database, actor: Actor, stores: Stores, dataset_id: str) -> Response:
    """Delete a dataset and then the files of its episodes, which nothing else names."""
    answer = delete_object(database, actor, "dataset", dataset_id)
    stores.episodes.remove_orphans(dataset_id, [])
    return answer


@router.delete("/scenes/{scene_id}", status_code=204, tags=["scenes"], response_class=Response)
def delete_scene(scene_id: ObjectId, database: DatabaseDep, actor: ActorDep) -> Response:
    """Delete a scene from which nothing was made."""
    return delete_object(database, actor, "scene", scene_id)


@router.delete("/checks/{check_id}", status_code=204, tags=["checks"], response_class=Response)
def delete_check(check_id: ObjectId, database: DatabaseDep, actor: ActorDep) -> Response:
    """Delete a check."""
    return delete_object(database, actor, "check", check_id)


@router.delete("/fits/{fit_id}", status_code=204, tags=["fits"], response_class=Response)
def delete_fit(fit_id: ObjectId, database: DatabaseDep, actor: ActorDep) -> Response:
    """Delete a fit that no trace, dataset or model uses."""
    return delete_object(database, actor, "fit", fit_id)


@router.delete("/traces/{trace_id}", status_code=204, tags=["traces"], response_class=Response)
def delete_trace(trace_id: ObjectId, database: DatabaseDep, actor: ActorDep) -> Response:
    """Delete a trace that no dataset, model or assessment uses."""
    return delete_object(database, actor, "trace", trace_id)


@router.delete("/datasets/{dataset_id}", status_code=204, tags=["datasets"], response_class=Response)
def delete_dataset(
    dataset_id: ObjectId, database: DatabaseDep, actor: ActorDep, stores: StoresDep
) -> Response:
    """Delete a dataset, with its episodes, that no model was trained on."""
    return delete_episodes(database, actor, stores, dataset_id)


@router.delete("/rollouts/{rollout_id}", status_code=204, tags=["rollouts"], response_class=Response)
def delete_rollout(rollout_id: ObjectId, database: DatabaseDep, actor: ActorDep) -> Response:
    """Delete a rollout."""
    return delete_object(database, actor, "rollout", rollout_id)


@router.delete("/plans/{plan_id}", status_code=204, tags=["plans"], response_class=Response)
def delete_plan(plan_id: ObjectId, database: DatabaseDep, actor: ActorDep) -> Response:
    """Delete a plan."""
    return delete_object(database, actor, "plan", plan_id)


@router.delete("/assessments/{assessment_id}", status_code=204, tags=["assessments"], response_class=Response)
def delete_assessment(assessment_id: ObjectId, database: DatabaseDep, actor: ActorDep) -> Response:
    """Delete an assessment."""
    return delete_object(database, actor, "assessment", assessment_id)


@router.delete("/models/{name}/versions/{version}", status_code=204, tags=["models"], response_class=Response)
def delete_version(name: ModelName, version: Version, database: DatabaseDep, actor: ActorDep) -> Response:
    """Delete a version without aliases, rollouts, plans and assessments; its number is never given again."""
    with database.session() as session:
        number = registry.resolve(session, name, version)
        removal.remove_version(session, name, number)
        audit.record(session, actor, "model.deleted", f"{name}:{number}")
    return Response(status_code=204)
