"""The body of a model version, for 3D views: what it looks like from outside, and where in the recording it begins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors

from physworld.arrays import Array
from physworld_schemas.model import ModelVersion
from physworld_services.dashboard.pages_models import card_of
from physworld_services.dashboard.site import Site
from physworld_storage import resources, videos

if TYPE_CHECKING:
    from physworld_services.dashboard.surfaces import Surface
    from physworld_services.dashboard.tubes import Tubes

KEPT = {"Cache-Control": "private, max-age=600"}
"""Headers of what belongs to a version, which never changes."""
WEIGHTS, TWIN, SPLAT = "model.safetensors", "twin.npz", "splat.ply"
MOST_FILMS = 50
"""Of a scene, among which a fitted splat is looked for."""
REST, PARTICLES, TIMES, HISTORY = "rest.vertices", "particle.index", "start.time", "start.history"


def surface_of(site: Site, version: ModelVersion) -> Surface | Tubes | None:
    """The surface of the body that the version learned from its twin; None where there is none to draw."""
    tensors = _tensors(site, version)
    if not {REST, PARTICLES} <= tensors.keys() or version.fit_id is None:
        return None
    with site.database.reading() as session:
        fit = resources.get_fit(session, version.fit_id)
    twin = site.arrays(fit.artifacts, TWIN)
    if twin is None:
        return None
    from physworld_services.dashboard.surfaces import body_surface  # loads the engine

    return body_surface(twin, tensors[REST].astype(np.float64), tensors[PARTICLES].astype(int))


def start_s(site: Site, version: ModelVersion, ticks: int | None = None) -> float:
    """When in the recording the model has so many ticks behind it [s]; None: all of its history, as a session has."""
    tensors = _tensors(site, version)
    dt_s = card_of(site, version).get("architecture", {}).get("dt_s")
    if dt_s is None or not {TIMES, HISTORY} <= tensors.keys():
        return 0.0
    ticks = len(tensors[HISTORY]) - 1 if ticks is None else ticks
    return float(tensors[TIMES][0]) + ticks * float(dt_s)


def start_vertices(site: Site, version: ModelVersion) -> Array | None:
    """The graph's vertices where the recording begins [m], (n, 3); None where its weights cannot be read."""
    history = _tensors(site, version).get(HISTORY)
    return None if history is None else history[0]


def splat_of(site: Site, version: ModelVersion) -> str | None:
    """Digest of the body's splat in the recording's first frame; None without one.

    It is what was put beside the scene, else that of the newest film that fitted one to the scene's pictures.
    """
    if version.scene_id is None:
        return None
    with site.database.reading() as session:
        files = list(resources.get_scene(session, version.scene_id).artifacts)
        for video in videos.list_videos(session, scene_id=version.scene_id, limit=MOST_FILMS).data:
            files += video.artifacts
    return next((item.sha256 for item in files if item.name == SPLAT), None)


def _tensors(site: Site, version: ModelVersion) -> Mapping[str, Array]:
    """What the version's weights say of its body; empty where they cannot be read."""
    found = next((item for item in version.artifacts if item.name == WEIGHTS), None)
    return {} if found is None else site.kept(("body", found.sha256), lambda: _body_of(site, found.sha256))


def _body_of(site: Site, sha256: str) -> Mapping[str, Array]:
    try:
        tensors: dict[str, Array] = load_tensors(site.artifacts.read_bytes(sha256))
    except SafetensorError:
        return {}
    return {name: tensors[name] for name in (REST, PARTICLES, TIMES, HISTORY) if name in tensors}
