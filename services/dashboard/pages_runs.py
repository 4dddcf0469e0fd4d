"""Fits, rollouts and plans: their lists, and the page of a rollout or a plan with its result and a player."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

from physworld.arrays import Array
from physworld_schemas.arrays import EncodedArray
from physworld_schemas.model import ModelVersion
from physworld_schemas.plan import Plan
from physworld_schemas.rollout import Rollout
from physworld_services.dashboard.clouds import Cloud, Layer, measured_layers, resampled, thinned
from physworld_services.dashboard.lineage import lineage_graph
from physworld_services.dashboard.lists import Asked
from physworld_services.dashboard.pages_scenes import layer_response, recording_of
from physworld_services.dashboard.pages_videos import films_of
from physworld_services.dashboard.site import BASE, Site
from physworld_services.dashboard.version_body import KEPT, start_s, surface_of
from physworld_storage import overview, registry, resources, runs
from physworld_storage.errors import NotFound

PAGE_SIZE = 50
LAYERS: dict[runs.RunKind, tuple[tuple[str, str, str], ...]] = {
    "rollout": (("points", "Predicted points", "model"), ("vertices", "Vertices", "particles")),
    "plan": (
        ("predicted", "Predicted", "model"),
        ("executed", "In the twin", "twin"),
        ("goal_places", "Goal", "measured"),
        ("goal_shape", "Goal", "measured"),
    ),
}


def router(site: Site) -> APIRouter:
    """Pages below ``/fits``, ``/rollouts`` and ``/plans``."""
    routes = APIRouter()

    @routes.get("/fits")
    def fits(request: Request, asked: Asked) -> HTMLResponse:
        with site.database.reading() as session:
            page = resources.list_fits(
                session, limit=PAGE_SIZE, cursor=asked.cursor, state=asked.state, search=asked.q
            )
            names = overview.scene_names(session, {fit.scene_id for fit in page.data})
        context = asked.context(page.next_cursor)
        return site.page(request, "fits.html", fits=page.data, names=names, **context)

    for kind in LAYERS:
        _add(routes, site, kind)
    return routes


def _add(routes: APIRouter, site: Site, kind: runs.RunKind) -> None:
    """The pages of one kind of run: its list, a run, and the run's result as moving points."""

    @routes.get(f"/{kind}s")
    def index(request: Request, asked: Asked) -> HTMLResponse:
        with site.database.reading() as session:
            page = runs.list_runs(
                session, kind, limit=PAGE_SIZE, cursor=asked.cursor, model=asked.model, search=asked.q
            )
        return site.page(request, f"{kind}s.html", runs=page.data, **asked.context(page.next_cursor))

    @routes.get(f"/{kind}s/{{run_id}}")
    def one(request: Request, run_id: str) -> HTMLResponse:
        run = _run(site, kind, run_id)
        has_cloud = site.arrays(run.artifacts, runs.RESULT[kind]) is not None
        graph = lineage_graph(site, _version(site, run).scene_id, run_id)
        films = films_of(site, ("rollout", run_id)) if kind == "rollout" else []
        return site.page(request, f"{kind}.html", run=run, has_cloud=has_cloud, graph=graph, films=films)

    @routes.get(f"/{kind}s/{{run_id}}/cloud")
    def cloud(run_id: str) -> Response:
        described = _cloud(site, _run(site, kind, run_id), kind).describe(f"{BASE}/{kind}s/{run_id}/cloud")
        return JSONResponse(described)

    @routes.get(f"/{kind}s/{{run_id}}/surface")
    def surface(run_id: str) -> Response:
        found = surface_of(site, _version(site, _run(site, kind, run_id)))
        if found is None:
            raise NotFound(f"surface of {kind}", run_id)
        return JSONResponse(found.document(), headers=KEPT)

    @routes.get(f"/{kind}s/{{run_id}}/cloud/{{layer}}")
    def cloud_layer(run_id: str, layer: str) -> Response:
        return layer_response(_cloud(site, _run(site, kind, run_id), kind), layer)


def _run(site: Site, kind: runs.RunKind, run_id: str) -> Rollout | Plan:
    with site.database.reading() as session:
        return runs.get_run(session, kind, run_id)


def _version(site: Site, run: Rollout | Plan) -> ModelVersion:
    with site.database.reading() as session:
        return registry.get_version(session, run.model, run.version)


def _cloud(site: Site, run: Rollout | Plan, kind: runs.RunKind) -> Cloud:
    """The result as moving points: of a rollout its first candidate, with the grips that were asked for.

    Where the vertices of a rollout carry a surface, that is drawn in their place, and the recording beside it.
    """
    arrays = site.arrays(run.artifacts, runs.RESULT[kind])
    if arrays is None:
        raise NotFound(f"result of {kind}", run.id or "")
    times = np.asarray(arrays["times"], dtype=float)
    layers = []
    for name, label, role in LAYERS[kind]:
        if name in arrays:
            layers.append(thinned(Layer(name, label, role, _frames(arrays[name], len(times)))))
    driven = arrays.get("controllers") if kind == "plan" else _asked(site, run)
    if driven is not None:
        paths = driven[-len(times) :] if kind == "plan" else _frames(driven, len(times))
        layers.append(Layer("controllers", "Grips", "controllers", paths.astype(np.float32)))
    if not isinstance(run, Rollout):
        return Cloud(times, layers)
    version = _version(site, run)
    recorded = _recorded(site, version, run, times)
    if recorded is not None:
        layers.append(recorded)
    if "vertices" not in arrays or surface_of(site, version) is None:
        return Cloud(times, layers)
    layers = [replace(layer, shown=False) if layer.name == "vertices" else layer for layer in layers]
    return Cloud(times, layers, surface=(f"{BASE}/rollouts/{run.id}/surface", "vertices"))


def _recorded(site: Site, version: ModelVersion, run: Rollout, times: Array) -> Layer | None:
    """What was measured at the moments of a rollout that begins as the recording did; None of another one."""
    if version.scene_id is None or run.config.get("start", "recording") != "recording":
        return None
    with site.database.reading() as session:
        record = resources.get_scene(session, version.scene_id)
    recording = recording_of(site, record)
    measured = next(layer for layer in measured_layers(recording) if layer.name == "measured")
    points = resampled(measured.points, recording.times - start_s(site, version, ticks=0), times)
    return replace(measured, label="Recording", points=points.astype(np.float32), opacity=0.45)


def _frames(values: Array, frames: int) -> Array:
    """One path (frames, n, 3) of points: the first of several candidates; a still cloud stays where it is."""
    path = np.asarray(values, dtype=np.float32)
    path = path[0] if path.ndim == 4 else path
    if path.ndim == 2:
        return np.repeat(path[None], frames, axis=0)
    index = np.round(np.linspace(0, len(path) - 1, frames)).astype(int)
    return path if len(path) == frames else path[index]


def _asked(site: Site, run: Rollout | Plan) -> Array | None:
    """The control paths of a rollout's request, None without them."""
    found = next((item for item in run.artifacts if item.name == runs.REQUEST), None)
    if found is None:
        return None
    request: dict[str, Any] = json.loads(site.artifacts.read_bytes(found.sha256))
    return EncodedArray.model_validate(request["controllers"]).numpy()
