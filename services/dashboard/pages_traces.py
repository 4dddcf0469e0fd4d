"""Traces: the list, a trace with its verdict, errors before and after, 3D overlay and path; and assessments."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

from physworld_schemas.scene import Scene as SceneRecord
from physworld_schemas.trace import Trace
from physworld_services.dashboard.clouds import Cloud, Layer, measured_layers, resampled, scene_cloud, thinned
from physworld_services.dashboard.curves import chart, frame_errors, split_time
from physworld_services.dashboard.lineage import lineage_graph
from physworld_services.dashboard.lists import Asked
from physworld_services.dashboard.pages_scenes import layer_response, recording_of
from physworld_services.dashboard.site import BASE, Site
from physworld_storage import overview, resources, traces
from physworld_storage.errors import NotFound

PAGE_SIZE = 50
# The page of a trace brings its own scripts: it gets no access to this site, whatever it holds.
PAGE_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:"
)


def router(site: Site) -> APIRouter:
    """Pages below ``/traces`` and ``/assessments``."""
    routes = APIRouter()

    @routes.get("/traces")
    def index(request: Request, asked: Asked) -> HTMLResponse:
        with site.database.reading() as session:
            page = traces.list_traces(
                session, limit=PAGE_SIZE, cursor=asked.cursor, state=asked.state, search=asked.q
            )
            names = overview.scene_names(session, {trace.scene_id for trace in page.data})
        context = asked.context(page.next_cursor)
        return site.page(request, "traces.html", traces=page.data, names=names, **context)

    @routes.get("/traces/{trace_id}")
    def trace_page(request: Request, trace_id: str) -> HTMLResponse:
        trace, record = _load(site, trace_id)
        return site.page(
            request,
            "trace.html",
            trace=trace,
            scene=record,
            extra=trace.model_extra or {},
            candidates=_best(trace),
            graph=lineage_graph(site, trace.scene_id, trace_id),
            has_tracks=_artifact(trace, traces.TRACKS) is not None,
            has_page=_artifact(trace, traces.PAGE) is not None,
        )

    @routes.get("/traces/{trace_id}/report")
    def report(trace_id: str) -> Response:
        trace, _ = _load(site, trace_id)
        sha256 = _artifact(trace, traces.PAGE)
        if sha256 is None:
            raise NotFound("page of trace", trace_id)
        content = site.artifacts.read_bytes(sha256)
        return HTMLResponse(content, headers={"Content-Security-Policy": PAGE_POLICY})

    @routes.get("/traces/{trace_id}/curve")
    def curve(trace_id: str) -> Response:
        trace, record = _load(site, trace_id)
        recording = recording_of(site, record)
        tracks = _tracks(site, trace)
        errors = {
            name: frame_errors(recording, resampled(tracks[name], tracks["times"], recording.times))
            for name in ("before", "after")
        }
        floor = (trace.held_out or {}).get("noise_floor")
        return HTMLResponse(chart(recording.times, errors, split=split_time(recording), floor_m=floor))

    @routes.get("/traces/{trace_id}/cloud")
    def cloud(trace_id: str) -> Response:
        return JSONResponse(_cloud(site, *_load(site, trace_id)).describe(f"{BASE}/traces/{trace_id}/cloud"))

    @routes.get("/traces/{trace_id}/cloud/{layer}")
    def cloud_layer(trace_id: str, layer: str) -> Response:
        return layer_response(_cloud(site, *_load(site, trace_id)), layer)

    @routes.get("/assessments/{assessment_id}")
    def assessment_page(request: Request, assessment_id: str) -> HTMLResponse:
        with site.database.reading() as session:
            found = traces.get_assessment(session, assessment_id)
            names = overview.scene_names(session, [found.scene_id])
        return site.page(request, "assessment.html", assessment=found, scene_name=names[found.scene_id])

    return routes


def _load(site: Site, trace_id: str) -> tuple[Trace, SceneRecord]:
    with site.database.reading() as session:
        trace = traces.get_trace(session, trace_id)
        return trace, resources.get_scene(session, trace.scene_id)


def _artifact(trace: Trace, name: str) -> str | None:
    return next((item.sha256 for item in trace.artifacts if item.name == name), None)


def _tracks(site: Site, trace: Trace) -> Any:
    arrays = site.arrays(trace.artifacts, traces.TRACKS)
    if arrays is None:
        raise NotFound("tracks of trace", trace.id)
    return arrays


def _cloud(site: Site, trace: Trace, record: SceneRecord) -> Cloud:
    recording = recording_of(site, record)
    tracks = _tracks(site, trace)
    layers = measured_layers(recording)
    for name, label, role in (("after", "After", "after"), ("before", "Before", "before")):
        points = resampled(tracks[name], tracks["times"], recording.times)
        layers.append(thinned(Layer(name, label, role, points, shown=name == "after", pairs="measured")))
    return scene_cloud(recording, layers)


def _best(trace: Trace) -> list[dict[str, Any]]:
    """Candidates by their score, the best first; a score below zero is rounding."""
    floored = [{**item, "score": max(0.0, item.get("score") or 0.0)} for item in trace.candidates]
    return sorted(floored, key=lambda item: -item["score"])
