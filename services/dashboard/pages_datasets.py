"""Datasets: the list, a dataset's episodes with one of them in 3D, and how far the writing is, live."""

from __future__ import annotations

import json
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

from physworld_schemas.library import catalogue
from physworld_services.api.exports import FORMATS
from physworld_services.api.routes.datasets import EpisodeIndex, episode_file, export_file
from physworld_services.dashboard import live
from physworld_services.dashboard.clouds import Cloud, Layer, thinned
from physworld_services.dashboard.lineage import lineage_graph
from physworld_services.dashboard.lists import Asked
from physworld_services.dashboard.pages_scenes import layer_response
from physworld_services.dashboard.site import BASE, Site
from physworld_storage import overview, resources
from physworld_storage.errors import NotFound
from physworld_storage.jobs.kinds.pipeline import model_name_of

PAGE_SIZE = 50
COVERAGE = "coverage.svg"
CARD = "card.json"
SHOWN_REJECTIONS = 12
PICTURE_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
DONE_STATES = frozenset({"sealed", "failed", "cancelled"})

ExportPath = Annotated[str, Path(pattern=f"^({'|'.join(FORMATS)})$")]
Cursor = Annotated[str | None, Query(max_length=512)]


def router(site: Site) -> APIRouter:
    """Pages below ``/datasets``."""
    routes = APIRouter()

    @routes.get("/datasets")
    def index(request: Request, asked: Asked) -> HTMLResponse:
        with site.database.reading() as session:
            page = resources.list_datasets(
                session, limit=PAGE_SIZE, cursor=asked.cursor, state=asked.state, search=asked.q
            )
            names = overview.scene_names(session, (item.scene_id for item in page.data))
        context = asked.context(page.next_cursor)
        return site.page(request, "datasets.html", datasets=page.data, names=names, **context)

    @routes.get("/datasets/{dataset_id}")
    def page(
        request: Request, dataset_id: str, episode: int | None = None, cursor: Cursor = None
    ) -> HTMLResponse:
        with site.database.reading() as session:
            dataset = resources.get_dataset(session, dataset_id)
            scene = resources.get_scene(session, dataset.scene_id)
            episodes = resources.list_episodes(session, dataset_id, limit=PAGE_SIZE, cursor=cursor)
            chosen = episodes.data[0] if episodes.data else None
            if episode is not None:
                chosen = resources.get_episode(session, dataset_id, episode)
        files = {artifact.name: artifact.sha256 for artifact in dataset.artifacts}
        return site.page(
            request,
            "dataset.html",
            dataset=dataset,
            scene=scene,
            graph=lineage_graph(site, dataset.scene_id, dataset_id),
            model_name=model_name_of(scene.name),
            chosen=chosen,
            episodes=episodes.data,
            files=files,
            exports=catalogue().exports,
            rejections=_rejections(site, files),
            cursor=cursor,
            next_cursor=episodes.next_cursor,
        )

    @routes.get("/datasets/{dataset_id}/coverage.svg")
    def coverage(dataset_id: str) -> Response:
        with site.database.reading() as session:
            dataset = resources.get_dataset(session, dataset_id)
        digest = next((known.sha256 for known in dataset.artifacts if known.name == COVERAGE), None)
        if digest is None:
            raise NotFound("picture", f"{COVERAGE} of {dataset_id}")
        headers = {"Content-Security-Policy": PICTURE_POLICY, "Cache-Control": "private, max-age=86400"}
        return Response(site.artifacts.read_bytes(digest), headers=headers, media_type="image/svg+xml")

    @routes.get("/live/datasets/{dataset_id}")
    async def live_page(request: Request, dataset_id: str) -> Response:
        def render() -> tuple[str, bool]:
            with site.database.reading() as session:
                dataset = resources.get_dataset(session, dataset_id)
            return site.fragment(request, "_dataset.html", dataset=dataset), dataset.state in DONE_STATES

        return await live.stream(render)

    @routes.get("/datasets/{dataset_id}/episodes/{index}/cloud")
    def cloud(dataset_id: str, index: int) -> Response:
        url = f"{BASE}/datasets/{dataset_id}/episodes/{index}/cloud"
        return JSONResponse(_cloud(site, dataset_id, index).describe(url))

    @routes.get("/datasets/{dataset_id}/episodes/{index}/cloud/{layer}")
    def cloud_layer(dataset_id: str, index: int, layer: str) -> Response:
        return layer_response(_cloud(site, dataset_id, index), layer)

    @routes.get("/datasets/{dataset_id}/episodes/{index}/npz")
    def npz(dataset_id: str, index: EpisodeIndex) -> Response:
        return episode_file(dataset_id, index, site.database, site.stores)

    @routes.get("/datasets/{dataset_id}/export/{form}")
    def exported(dataset_id: str, form: ExportPath) -> Response:
        return export_file(dataset_id, form, None, site.database, site.stores)

    return routes


def _rejections(site: Site, files: dict[str, str]) -> dict[str, Any] | None:
    """What the card says of rejected tries, the first few of them; None without a card."""
    if CARD not in files:
        return None
    found: dict[str, Any] = json.loads(site.artifacts.read_bytes(files[CARD]))["rejections"]
    return {**found, "first": found["first"][:SHOWN_REJECTIONS]}


def _cloud(site: Site, dataset_id: str, index: int) -> Cloud:
    with site.database.reading() as session:
        episode = resources.get_episode(session, dataset_id, index)
    arrays, _attributes = site.episodes.verified(episode.path, episode.digest)
    layers = [thinned(Layer("particles", "Particles", "particles", np.asarray(arrays["particles"])))]
    if arrays["controllers"].shape[1]:
        controllers = np.asarray(arrays["controllers"])
        layers.append(thinned(Layer("controllers", "Controllers", "controllers", controllers)))
    return Cloud(np.asarray(arrays["times"]), layers)
