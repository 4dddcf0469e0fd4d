"""What tasks read: a scene and a twin, decoded once per process and then shared by its shards."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld.scene import Scene
from physworld_scenes.bundle import bundle_from_bytes
from physworld_schemas.base import Artifact, Reference
from physworld_storage import resources, traces
from physworld_storage.errors import Conflict, NotFound
from physworld_workers.stores import Stores

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

TWIN = "twin.npz"


def scene_of(stores: Stores, scene_id: str) -> Scene:
    """The scene, from its canonical archive. Raises NotFound, SceneInvalid."""
    return stores.cached(("scene", scene_id), lambda: _read_scene(stores, scene_id))


def twin_of(stores: Stores, fit_id: str, trace_id: str | None = None) -> Twin:
    """The calibrated twin of a ready fit, or of the trace where that added an effect. Raises NotFound, Conflict."""
    return stores.cached(("twin", fit_id, trace_id), lambda: _read_twin(stores, fit_id, trace_id))


def scene_reference(stores: Stores, scene_id: str) -> Reference:
    """The scene as an input in a lineage."""
    with stores.database.reading() as session:
        return Reference(kind="scene", id=scene_id, digest=resources.get_scene(session, scene_id).digest)


def fit_reference(stores: Stores, fit_id: str) -> Reference:
    """The fit as an input in a lineage; its digest is its twin's."""
    with stores.database.reading() as session:
        artifacts = resources.get_fit(session, fit_id).artifacts
    digests = {artifact.name: artifact.sha256 for artifact in artifacts}
    return Reference(kind="fit", id=fit_id, digest=digests.get(TWIN))


def trace_reference(stores: Stores, trace_id: str) -> Reference:
    """The trace as an input in a lineage; its digest is its report's."""
    with stores.database.reading() as session:
        artifacts = traces.get_trace(session, trace_id).artifacts
    digests = {artifact.name: artifact.sha256 for artifact in artifacts}
    return Reference(kind="trace", id=trace_id, digest=digests.get(traces.REPORT))


def made_from(stores: Stores, payload: dict[str, Any]) -> list[Reference]:
    """Scene, fit and trace of a payload as inputs in a lineage."""
    found = [scene_reference(stores, payload["scene_id"]), fit_reference(stores, payload["fit_id"])]
    if payload.get("trace_id") is not None:
        found.append(trace_reference(stores, payload["trace_id"]))
    return found


def npz_bytes(arrays: Mapping[str, Any]) -> bytes:
    """Arrays as an npz; the same arrays give the same bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def npz_arrays(data: bytes) -> dict[str, Array]:
    """The arrays of an npz; one that would need a pickle is refused with ValueError."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def named(artifacts: list[Artifact], name: str, owner: str) -> Artifact:
    """The artifact called ``name``. Raises NotFound."""
    for artifact in artifacts:
        if artifact.name == name:
            return artifact
    raise NotFound("artifact", f"{name} of {owner}")


def _read_scene(stores: Stores, scene_id: str) -> Scene:
    with stores.database.reading() as session:
        digest = resources.get_scene(session, scene_id).digest
    scene, _ = bundle_from_bytes(stores.artifacts.read_bytes(digest))
    return scene


def _read_twin(stores: Stores, fit_id: str, trace_id: str | None) -> Twin:
    from physworld.twin.twin import Twin

    with stores.database.reading() as session:
        fit = resources.get_fit(session, fit_id)
        trace = None if trace_id is None else traces.get_trace(session, trace_id)
    if fit.state != "ready":
        raise Conflict(f"fit {fit_id} is {fit.state}; its twin exists once it is ready")
    owner = trace if trace is not None and traces.leaves_twin(trace) else fit
    data = stores.artifacts.read_bytes(named(owner.artifacts, TWIN, owner.id).sha256)
    return Twin.from_arrays(npz_arrays(data), stores.settings.device)
