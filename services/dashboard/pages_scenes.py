"""Scenes: the list, a recording with its newest calibrated twin drawn over it, error curve, parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse, Response

from physworld.arrays import Array
from physworld.report import names
from physworld_schemas.fit import Fit
from physworld_schemas.model import ModelVersion
from physworld_schemas.scene import Scene as SceneRecord
from physworld_services.dashboard.clouds import (
    Cloud,
    Layer,
    measured_layers,
    resampled,
    scene_cloud,
    thinned,
)
from physworld_services.dashboard.curves import chart, frame_errors, given_curves, onto, split_time
from physworld_services.dashboard.lineage import lineage_graph
from physworld_services.dashboard.lists import Asked
from physworld_services.dashboard.pages_videos import films_of
from physworld_services.dashboard.residuals import map_picture, maps_page
from physworld_services.dashboard.samples import sample_folder
from physworld_services.dashboard.site import BASE, Site
from physworld_services.dashboard.tables import noise_floor_of
from physworld_storage import checks, resources, traces
from physworld_storage.errors import NotFound

if TYPE_CHECKING:
    from physworld.scene import Scene

PAGE_SIZE = 50
RELATED_SHOWN = 10
PREDICTION = "prediction.npz"
FOLLOWED = "followed.png"
"""Of a scene that was made of pictures here: what was followed in them."""
DECLARED_SHOWN = ("gravity_m_s2", "initial_state", "body", "ground", "grips", "notes")

FitId = Annotated[str | None, Query(max_length=64)]


def router(site: Site) -> APIRouter:
    """Pages below ``/scenes``, and the addresses of fits and checks, which its scene's page shows."""
    routes = APIRouter()

    @routes.get("/scenes")
    def index(request: Request, asked: Asked) -> HTMLResponse:
        with site.database.reading() as session:
            page = resources.list_scenes(session, limit=PAGE_SIZE, cursor=asked.cursor, search=asked.q)
        return site.page(
            request,
            "scenes.html",
            scenes=page.data,
            has_sample=sample_folder() is not None,
            **asked.context(page.next_cursor),
        )

    @routes.get("/fits/{fit_id}")
    def fit_page(fit_id: str) -> Response:
        with site.database.reading() as session:
            fit = resources.get_fit(session, fit_id)
        return RedirectResponse(f"{BASE}/scenes/{fit.scene_id}?fit={fit.id}", 303)

    @routes.get("/checks/{check_id}")
    def check_page(check_id: str) -> Response:
        with site.database.reading() as session:
            check = checks.get_check(session, check_id)
        return RedirectResponse(f"{BASE}/scenes/{check.scene_id}#check", 303)

    @routes.get("/checks/{check_id}/json")
    def check_file(check_id: str) -> Response:
        with site.database.reading() as session:
            check = checks.get_check(session, check_id)
        headers = {"Content-Disposition": f'attachment; filename="{check_id}.json"'}
        return Response(check.model_dump_json(indent=1), headers=headers, media_type="application/json")

    @routes.get("/scenes/{scene_id}")
    def page(request: Request, scene_id: str, fit: FitId = None) -> HTMLResponse:
        record, shown = _load(site, scene_id, fit)
        with site.database.reading() as session:
            fits = resources.list_fits(session, scene_id=scene_id, limit=RELATED_SHOWN).data
            datasets = resources.list_datasets(session, scene_id=scene_id, limit=RELATED_SHOWN).data
            checked = checks.list_checks(session, scene_id=scene_id, limit=RELATED_SHOWN).data
            traced = traces.list_traces(session, scene_id=scene_id, limit=RELATED_SHOWN).data
        return site.page(
            request,
            "scene.html",
            scene=record,
            fit=shown,
            has_curve=shown is not None and _has_curve(shown),
            has_maps=shown is not None and _has_prediction(shown),
            fits=fits,
            datasets=datasets,
            traces=traced,
            declared=_declared(record),
            checks=checked,
            films=films_of(site, ("scene", scene_id), *((("fit", shown.id),) if shown else ())),
            graph=lineage_graph(site, scene_id, fit or scene_id),
            check=next((item for item in checked if item.report is not None), None),
        )

    @routes.get("/scenes/{scene_id}/followed.png")
    def followed(scene_id: str) -> Response:
        with site.database.reading() as session:
            record = resources.get_scene(session, scene_id)
        picture = next((item for item in record.artifacts if item.name == FOLLOWED), None)
        if picture is None:
            raise NotFound("picture of scene", scene_id)
        return Response(site.artifacts.read_bytes(picture.sha256), media_type="image/png")

    @routes.get("/scenes/{scene_id}/cloud")
    def cloud(scene_id: str, fit: FitId = None) -> Response:
        record, shown = _load(site, scene_id, fit)
        query = f"?fit={shown.id}" if shown else ""
        return JSONResponse(_cloud(site, record, shown).describe(f"{BASE}/scenes/{scene_id}/cloud", query))

    @routes.get("/scenes/{scene_id}/cloud/{layer}")
    def cloud_layer(scene_id: str, layer: str, fit: FitId = None) -> Response:
        record, shown = _load(site, scene_id, fit)
        return layer_response(_cloud(site, record, shown), layer)

    @routes.get("/scenes/{scene_id}/curve")
    def curve(scene_id: str, fit: FitId = None) -> Response:
        record, shown = _load(site, scene_id, fit)
        recording = recording_of(site, record)
        errors: dict[str, Array] = {}
        given = given_curves(shown.metrics) if shown else None
        if given is not None:
            errors.update(
                {name: onto(given[0], values, recording.times) for name, values in given[1].items()}
            )
        tracks = predicted(site, shown, recording)
        if tracks is not None:
            errors["twin"] = frame_errors(recording, tracks)
        floor = noise_floor_of(shown.metrics) if shown else None
        return HTMLResponse(chart(recording.times, errors, split=split_time(recording), floor_m=floor))

    @routes.get("/scenes/{scene_id}/residuals")
    def residuals(scene_id: str, fit: FitId = None) -> Response:
        record, shown = _load(site, scene_id, fit)
        query = f"?fit={shown.id}" if shown else ""
        return maps_page(*_residuals(site, record, shown), f"{BASE}/scenes/{scene_id}/residuals", query)

    @routes.get("/scenes/{scene_id}/residuals/{label}.png")
    def residuals_picture(scene_id: str, label: str, fit: FitId = None) -> Response:
        return map_picture(*_residuals(site, *_load(site, scene_id, fit)), label)

    return routes


def recording_of(site: Site, record: SceneRecord) -> Scene:
    """The arrays of a scene. Raises NotFound where its archive is not among its artifacts."""
    recording = site.recording(record.artifacts)
    if recording is None:
        raise NotFound("archive of scene", record.id)
    return recording


def predicted(site: Site, made: Fit | ModelVersion | None, recording: Scene) -> Array | None:
    """The stored prediction of a fit or a version at the recording's times, (T, N, 3) [m]; None without one."""
    arrays = site.arrays(made.artifacts, PREDICTION) if made else None
    return None if arrays is None else resampled(arrays["tracks"], arrays["times"], recording.times)


def layer_response(cloud: Cloud, name: str) -> Response:
    """A layer's buffer. What is under its address never changes, so the browser may keep it for a while."""
    layer = cloud.layer(name)
    if layer is None:
        raise NotFound("layer", name)
    headers = {"Cache-Control": "private, max-age=600"}
    return Response(layer.buffer(), media_type="application/octet-stream", headers=headers)


def _load(site: Site, scene_id: str, fit_id: str | None) -> tuple[SceneRecord, Fit | None]:
    """The scene and the fit to show: the one asked for where it is ready, else the newest that is."""
    with site.database.reading() as session:
        record = resources.get_scene(session, scene_id)
        if fit_id is not None:
            fit = resources.get_fit(session, fit_id)
            if fit.state == "ready" and fit.scene_id == scene_id:
                return record, fit
        newest = resources.list_fits(session, scene_id=scene_id, state="ready", limit=1).data
    return record, newest[0] if newest else None


def _residuals(site: Site, record: SceneRecord, fit: Fit | None) -> tuple[Scene, dict[str, Array]]:
    recording = recording_of(site, record)
    tracks = predicted(site, fit, recording)
    if tracks is None:
        raise NotFound("prediction of scene", record.id)
    return recording, {"Twin": tracks}


def _cloud(site: Site, record: SceneRecord, fit: Fit | None) -> Cloud:
    recording = recording_of(site, record)
    layers = measured_layers(recording)
    arrays = site.arrays(fit.artifacts, PREDICTION) if fit else None
    if arrays is not None:
        tracks = resampled(arrays["tracks"], arrays["times"], recording.times)
        layers.append(thinned(Layer("predicted", "Twin", "twin", tracks, pairs="measured")))
        if "particles" in arrays:
            body = resampled(arrays["particles"], arrays["times"], recording.times)
            layers.append(thinned(Layer("particles", "Particles", "particles", body, opacity=0.4)))
    return scene_cloud(recording, layers)


def _has_curve(fit: Fit) -> bool:
    return _has_prediction(fit) or given_curves(fit.metrics) is not None


def _has_prediction(fit: Fit) -> bool:
    return any(item.name == PREDICTION for item in fit.artifacts)


def _declared(record: SceneRecord) -> list[tuple[str, object]]:
    """Declared facts worth a line: the body's one by one, the others as they are."""
    facts: list[tuple[str, object]] = []
    for key in DECLARED_SHOWN:
        value = (record.declared or {}).get(key)
        if key == "body" and isinstance(value, dict):
            facts += [(names.title(name), item) for name, item in value.items() if _is_short(item)]
        elif value not in (None, [], {}):
            facts.append((names.title(key), value if _is_short(value) else f"{len(value)} declared"))
    return facts


def _is_short(value: object) -> bool:
    return isinstance(value, str | int | float | dict) or (isinstance(value, list) and 0 < len(value) <= 4)
