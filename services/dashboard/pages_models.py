"""World models: the list, versions of a name, a version's card with errors, 3D overlay and files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

from physworld.arrays import Array
from physworld_schemas.model import Model, ModelVersion
from physworld_services.dashboard.clouds import Cloud, Layer, measured_layers, resampled, scene_cloud, thinned
from physworld_services.dashboard.comparisons import side_by_side
from physworld_services.dashboard.curves import (
    chart,
    comparison_chart,
    given_curves,
    turns_chart,
    versions_chart,
)
from physworld_services.dashboard.lineage import lineage_graph
from physworld_services.dashboard.lists import Asked
from physworld_services.dashboard.pages_scenes import PREDICTION, layer_response, predicted, recording_of
from physworld_services.dashboard.pages_videos import films_of
from physworld_services.dashboard.residuals import map_picture, maps_page
from physworld_services.dashboard.site import BASE, Site
from physworld_services.dashboard.tables import held_out_of, noise_floor_of
from physworld_storage import loops, overview, registry, resources
from physworld_storage.errors import NotFound

if TYPE_CHECKING:
    from physworld.scene import Scene

PAGE_SIZE = 50
CHOICES = 200
TURNS = 12
"""Newest loops of a model that its page shows."""
BASELINES = ("static", "rigid_follow", "constant_velocity")
MOST_COMPARED = 12
"""Versions beside the two of a comparison; its page offers the newest."""
CARD = "card.json"

Others = Annotated[Sequence[str], Query(max_length=MOST_COMPARED)]
Chosen = Annotated[str | None, Query(max_length=64)]


@dataclass(frozen=True)
class Entry:
    """A model of the list, its newest version, and that version's held-out track error [m]."""

    model: Model
    newest: ModelVersion | None
    track_m: float | None


def router(site: Site) -> APIRouter:
    """Pages below ``/models``."""
    routes = APIRouter()

    @routes.get("/models")
    def index(request: Request, asked: Asked) -> HTMLResponse:
        with site.database.reading() as session:
            page = registry.list_models(session, limit=PAGE_SIZE, cursor=asked.cursor, search=asked.q)
            newest = {
                model.name: registry.list_versions(session, model.name, limit=1).data for model in page.data
            }
        entries = [_entry(model, newest[model.name]) for model in page.data]
        return site.page(request, "models.html", entries=entries, **asked.context(page.next_cursor))

    @routes.get("/models/{name}")
    def model_page(request: Request, name: str, asked: Asked) -> HTMLResponse:
        with site.database.reading() as session:
            model = registry.get_model(session, name)
            page = registry.list_versions(
                session, name, limit=PAGE_SIZE, cursor=asked.cursor, state=asked.state, search=asked.q
            )
            turns = loops.list_loops(session, limit=TURNS, model=name).data
            names = overview.scene_names(session, {turn.scene_id for turn in turns})
        context = asked.context(page.next_cursor)
        context |= {"turns": turns, "names": names, "plot": turns_chart(turns, names)}
        return site.page(
            request, "model.html", model=model, versions=page.data, baselines=BASELINES, **context
        )

    @routes.get("/models/{name}/compare")
    def compare_page(
        request: Request, name: str, a: Chosen = None, b: Chosen = None, also: Others = ()
    ) -> HTMLResponse:
        with site.database.reading() as session:
            model = registry.get_model(session, name)
            ready = registry.list_versions(session, name, limit=CHOICES, state="ready").data
        numbers = [str(version.version) for version in ready]
        choices = [*sorted(model.aliases), *numbers]
        first = a or (numbers[1] if len(numbers) > 1 else next(iter(numbers), None))
        second = b or next(iter(numbers), None)
        chosen = () if first is None or second is None else (first, second, *also)
        shown = _distinct(site, name, chosen)
        floor = next((floor for one in shown if (floor := noise_floor_of(one.metrics)) is not None), None)
        return site.page(
            request,
            "compare.html",
            model=model,
            choices=choices,
            a=first,
            b=second,
            also=[one.version for one in shown[2:]],
            numbers=numbers[:MOST_COMPARED],
            found=side_by_side(shown) if shown else None,
            plots=[chart for draw in (versions_chart, comparison_chart) if (chart := draw(shown, floor))],
        )

    @routes.get("/models/{name}/{number}")
    def version_page(request: Request, name: str, number: str) -> HTMLResponse:
        version = _version(site, name, number)
        return site.page(
            request,
            "version.html",
            version=version,
            card=card_of(site, version),
            films=films_of(site, ("model", f"{version.name}:{version.version}")),
            graph=lineage_graph(site, version.scene_id, f"{version.name}:{version.version}"),
            has_curve=given_curves(version.metrics) is not None,
            has_cloud=version.scene_id is not None and site.arrays(version.artifacts, PREDICTION) is not None,
        )

    @routes.get("/models/{name}/{number}/curve")
    def curve(name: str, number: str) -> Response:
        version = _version(site, name, number)
        given = given_curves(version.metrics)
        if given is None:
            raise NotFound("curve of model version", f"{name}:{number}")
        return HTMLResponse(chart(*given, floor_m=noise_floor_of(version.metrics)))

    @routes.get("/models/{name}/{number}/residuals")
    def residuals(name: str, number: str) -> Response:
        url = f"{BASE}/models/{name}/{number}/residuals"
        return maps_page(*_residuals(site, _version(site, name, number)), url)

    @routes.get("/models/{name}/{number}/residuals/{label}.png")
    def residuals_picture(name: str, number: str, label: str) -> Response:
        return map_picture(*_residuals(site, _version(site, name, number)), label)

    @routes.get("/models/{name}/{number}/cloud")
    def cloud(name: str, number: str) -> Response:
        url = f"{BASE}/models/{name}/{number}/cloud"
        return JSONResponse(_cloud(site, _version(site, name, number)).describe(url))

    @routes.get("/models/{name}/{number}/cloud/{layer}")
    def cloud_layer(name: str, number: str, layer: str) -> Response:
        return layer_response(_cloud(site, _version(site, name, number)), layer)

    return routes


def _distinct(site: Site, name: str, chosen: Sequence[str]) -> list[ModelVersion]:
    """The versions that are chosen, each once, in the order of the choice."""
    with site.database.reading() as session:
        found = [registry.get_version(session, name, one) for one in chosen]
    return list({one.version: one for one in found}.values())


def _version(site: Site, name: str, number: int | str) -> ModelVersion:
    with site.database.reading() as session:
        return registry.get_version(session, name, number)


def card_of(site: Site, version: ModelVersion) -> dict[str, Any]:
    """The version's card; empty where there is none that can be read."""
    found = next((item for item in version.artifacts if item.name == CARD), None)
    if found is None:
        return {}
    try:
        card = json.loads(site.artifacts.read_bytes(found.sha256))
    except ValueError:
        return {}
    return card if isinstance(card, dict) else {}


def _recording(site: Site, version: ModelVersion) -> Scene:
    """What the version was made of and its prediction is held against. Raises NotFound where it has neither."""
    if version.scene_id is None or all(item.name != PREDICTION for item in version.artifacts):
        raise NotFound("prediction of model version", f"{version.name}:{version.version}")
    with site.database.reading() as session:
        record = resources.get_scene(session, version.scene_id)
    return recording_of(site, record)


def _residuals(site: Site, version: ModelVersion) -> tuple[Scene, dict[str, Array]]:
    """The recording, and what the version and its twin predict of it."""
    recording = _recording(site, version)
    found = {"World model": predicted(site, version, recording)}
    if version.fit_id is not None:
        with site.database.reading() as session:
            fit = resources.get_fit(session, version.fit_id)
        found["Twin"] = predicted(site, fit, recording)
    return recording, {label: tracks for label, tracks in found.items() if tracks is not None}


def _cloud(site: Site, version: ModelVersion) -> Cloud:
    """What the model predicted over what was measured, on the recording's time line."""
    recording = _recording(site, version)
    arrays = site.arrays(version.artifacts, PREDICTION) or {}
    layers = measured_layers(recording)
    for key, label, role, opacity in (
        ("tracks", "World model", "model", 1.0),
        ("vertices", "Vertices", "particles", 0.75),
    ):
        if key in arrays:
            own = "tick_times" if key == "vertices" and "tick_times" in arrays else "times"  # its own clock's
            points = resampled(arrays[key], arrays[own], recording.times)
            pairs = "measured" if key == "tracks" else None
            layers.append(thinned(Layer(key, label, role, points, opacity=opacity, pairs=pairs)))
    return scene_cloud(recording, layers)


def _entry(model: Model, newest: list[ModelVersion]) -> Entry:
    version = newest[0] if newest else None
    table = held_out_of(version.metrics) if version else None
    errors = table.get("track_m", {}) if table else {}
    return Entry(model, version, errors.get("world_model_finetuned", errors.get("world_model")))
