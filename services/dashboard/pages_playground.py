"""The playground of a model version: its page, its live session, its body's surface, and the recording beside it."""

from __future__ import annotations

from urllib.parse import urlencode

import numpy as np
from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

from physworld_schemas.model import ModelVersion
from physworld_services.dashboard.access import require_same_origin, require_writer
from physworld_services.dashboard.clouds import Cloud, Layer, measured_layers, resampled, scene_cloud, thinned
from physworld_services.dashboard.pages_scenes import PREDICTION, layer_response, recording_of
from physworld_services.dashboard.site import BASE, Site
from physworld_services.dashboard.version_body import KEPT, splat_of, start_s, start_vertices, surface_of
from physworld_storage import registry, resources
from physworld_storage.access import tickets
from physworld_storage.access.api_keys import ApiKey
from physworld_storage.errors import NotFound
from physworld_storage.jobs.kinds.rollout import ready_version


def router(site: Site) -> APIRouter:
    """Pages below ``/models/{name}/{number}``, for who may write: a session keeps the service busy."""
    routes = APIRouter(prefix="/models/{name}/{number}", dependencies=[Depends(require_writer)])

    @routes.get("/playground")
    def playground(request: Request, name: str, number: str) -> HTMLResponse:
        return site.page(request, "playground.html", version=_version(site, name, number))

    @routes.post("/live", dependencies=[Depends(require_same_origin)])
    def live_ticket(request: Request, name: str, number: str) -> Response:
        viewer: ApiKey = request.state.viewer
        version = _version(site, name, number).version
        with site.database.session() as session:
            ready_version(session, name, version)
            ticket, _ = tickets.issue(session, viewer.credential, f"session:{name}:{version}")
        return JSONResponse({"path": f"/v1/live?{urlencode(_session(name, version, ticket))}"})

    @routes.get("/surface")
    def surface(name: str, number: str) -> Response:
        found = surface_of(site, _version(site, name, number))
        return JSONResponse(None if found is None else found.document(), headers=KEPT)

    @routes.get("/splat")
    def splat(name: str, number: str) -> Response:
        version = _version(site, name, number)
        found, vertices = splat_of(site, version), start_vertices(site, version)
        if found is None or vertices is None:
            return JSONResponse(None)
        carried = np.round(vertices.astype(np.float64), 6).ravel().tolist()
        return JSONResponse({"url": f"{BASE}/artifacts/{found}", "vertices": carried})

    @routes.get("/ghost")
    def ghost(name: str, number: str) -> Response:
        version = _version(site, name, number)
        cloud = _ghost(site, version)
        if cloud is None:
            return JSONResponse(None)
        described = cloud.describe(f"{BASE}/models/{name}/{number}/ghost")
        return JSONResponse({**described, "start_s": start_s(site, version)})

    @routes.get("/ghost/{layer}")
    def ghost_layer(name: str, number: str, layer: str) -> Response:
        cloud = _ghost(site, _version(site, name, number))
        if cloud is None:
            raise NotFound("recording of model version", f"{name}:{number}")
        return layer_response(cloud, layer)

    return routes


def _session(name: str, number: int, ticket: str) -> dict[str, str | int]:
    """The query of a live session: two frames a tick, interpolated, of the graph's vertices."""
    return {"model": name, "version": number, "ticket": ticket, "frames": 2, "part": "vertices"}


def _version(site: Site, name: str, number: str) -> ModelVersion:
    with site.database.reading() as session:
        return registry.get_version(session, name, number)


def _ghost(site: Site, version: ModelVersion) -> Cloud | None:
    """The recording that the version was made of, and what its twin predicts of it; None without a recording."""
    if version.scene_id is None:
        return None
    with site.database.reading() as session:
        record = resources.get_scene(session, version.scene_id)
        fit = resources.get_fit(session, version.fit_id) if version.fit_id else None
    recording = recording_of(site, record)
    layers = [layer for layer in measured_layers(recording) if layer.name == "measured"]
    arrays = site.arrays(fit.artifacts, PREDICTION) if fit else None
    if arrays is not None:
        name = "particles" if "particles" in arrays else "tracks"
        points = resampled(arrays[name], arrays["times"], recording.times)
        layers.append(
            thinned(Layer("twin", "Twin (recorded motion)", "twin", points.astype(np.float32), shown=False))
        )
    driven = recording.controllers.astype(np.float32)
    layers.append(Layer("controllers", "Recorded grips", "controllers", driven, shown=False))
    return scene_cloud(recording, layers)
