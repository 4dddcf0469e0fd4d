"""Deletions: an object goes when nothing was made from it; files that nobody names follow within a day."""

from __future__ import annotations

import inspect

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


MEANING = {
    "scene": "Delete a scene from which nothing was made.",
    "check": "Delete a check.",
    "fit": "Delete a fit that no trace, dataset, model or film uses.",
    "trace": "Delete a trace that no dataset, model or assessment uses.",
    "dataset": "Delete a dataset, with its episodes, that no model was trained on.",
    "rollout": "Delete a rollout that no film shows.",
    "plan": "Delete a plan.",
    "video": "Delete a film.",
    "assessment": "Delete an assessment.",
}
"""What the route of each kind of ``removal.KINDS`` does."""


def delete_object(database: Database, stores: Stores, actor: Actor, kind: str, object_id: str) -> None:
    """Delete, and leave a line in the audit log; the files of a dataset's episodes go too, which nothing else names.

    Args:
        database: holds the rows.
        stores: hold the files.
        actor: who deletes, for the audit log.
        kind: of the object, as references name it.
        object_id: its id.

    Raises:
        NotFound: there is no such object.
        Conflict: something else still needs it.
    """
    with database.session() as session:
        removal.remove(session, kind, object_id)
        audit.record(session, actor, f"{kind}.deleted", object_id)
    if kind == "dataset":
        stores.episodes.remove_orphans(object_id, [])


def _add(kind: str, meaning: str) -> None:
    """The route of one kind; its parameter has the kind's name, as in the other routes of the object."""
    parameter = f"{kind}_id"

    def delete(database: DatabaseDep, stores: StoresDep, actor: ActorDep, **named: str) -> Response:
        delete_object(database, stores, actor, kind, named[parameter])
        return Response(status_code=204)

    own = [inspect.Parameter(parameter, inspect.Parameter.KEYWORD_ONLY, annotation=ObjectId)]
    own += [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=dependency)
        for name, dependency in (("database", DatabaseDep), ("stores", StoresDep), ("actor", ActorDep))
    ]
    delete.__dict__["__signature__"] = inspect.Signature(own)
    delete.__name__, delete.__doc__ = f"delete_{kind}", meaning
    path = f"/{kind}s/{{{parameter}}}"
    router.delete(path, status_code=204, tags=[f"{kind}s"], response_class=Response)(delete)


for kind, meaning in MEANING.items():
    _add(kind, meaning)


@router.delete("/models/{name}/versions/{version}", status_code=204, tags=["models"], response_class=Response)
def delete_version(name: ModelName, version: Version, database: DatabaseDep, actor: ActorDep) -> Response:
    """Delete a version without aliases, rollouts, plans and assessments; its number is never given again."""
    with database.session() as session:
        number = registry.resolve(session, name, version)
        removal.remove_version(session, name, number)
        audit.record(session, actor, "model.deleted", f"{name}:{number}")
    return Response(status_code=204)
