"""What every page shares: templates, static files by digest, stores, parsed recordings."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import numpy as np
from fastapi import Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from physworld.arrays import Array
from physworld_scenes.bundle import bundle_from_bytes
from physworld_scenes.declaration import KINDS
from physworld_schemas.base import Artifact
from physworld_schemas.library import catalogue
from physworld_schemas.scene import Axis
from physworld_services import guide
from physworld_services.dashboard import text
from physworld_services.dashboard.byte_cache import ByteCache
from physworld_services.dashboard.tables import held_out_columns, held_out_of, held_out_rows, noise_floor_of
from physworld_services.stores import Stores
from physworld_storage.access.api_keys import ApiKey
from physworld_storage.database import Database
from physworld_storage.settings import Settings

if TYPE_CHECKING:
    from physworld.scene import Scene

Kept = TypeVar("Kept")
BASE = "/dashboard"
HERE = Path(__file__).parent
STATIC = HERE / "static"
CACHED_BYTES = 256 * 2**20
"""Of parsed recordings and arrays that a process keeps between requests."""


class Site:
    """The dashboard's stores and templates; one per process, safe between threads."""

    def __init__(self, settings: Settings, database: Database, stores: Stores) -> None:
        self.settings = settings
        self.database = database
        self.stores = stores
        self.artifacts = stores.artifacts
        self.episodes = stores.episodes
        self._templates = environment_of_pages()
        self._parsed = ByteCache(CACHED_BYTES)

    def page(self, request: Request, template: str, *, status: int = 200, **context: Any) -> HTMLResponse:
        """A whole page. Who looks is taken from the request, where ``access.require_viewer`` left it."""
        return HTMLResponse(self.fragment(request, template, **context), status)

    def fragment(self, request: Request, template: str, **context: Any) -> str:
        """A rendered template, e.g. the part of a page that a live stream sends again."""
        viewer: ApiKey | None = getattr(request.state, "viewer", None)
        may_write = viewer is not None and viewer.allows("write")
        may_manage = viewer is not None and viewer.allows("admin")
        known = {"viewer": viewer, "may_write": may_write, "may_manage": may_manage}
        return self._templates.get_template(template).render(**known, **context)

    def recording(self, artifacts: list[Artifact]) -> Scene | None:
        """The recording behind a scene's artifacts: its canonical archive, parsed; None without one."""
        archive = next((item for item in artifacts if item.name.endswith(".zip")), None)
        if archive is None:
            return None
        return self._parsed.get(("scene", archive.sha256), lambda: self._read_scene(archive.sha256))

    def arrays(self, artifacts: list[Artifact], name: str) -> Mapping[str, Array] | None:
        """The arrays of the artifact called ``name`` (an npz without pickles); None without one."""
        found = next((item for item in artifacts if item.name == name), None)
        if found is None:
            return None
        return self._parsed.get(("arrays", found.sha256), lambda: self._read_arrays(found.sha256))

    def kept(self, key: tuple[str, str], make: Callable[[], Kept]) -> Kept:
        """What ``make`` gives for a digest, kept between requests as long as there is room."""
        return self._parsed.get(key, make)

    def _read_scene(self, sha256: str) -> Scene:
        scene, _warnings = bundle_from_bytes(self.artifacts.read_bytes(sha256))
        return scene

    def _read_arrays(self, sha256: str) -> Mapping[str, Array]:
        with np.load(io.BytesIO(self.artifacts.read_bytes(sha256)), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}


def environment_of_pages() -> Environment:
    """Templates with their filters and names."""
    environment = Environment(
        loader=FileSystemLoader(HERE / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(text.FILTERS)
    environment.globals.update(
        base=BASE,
        kinds=KINDS,
        axes=get_args(Axis),
        static=_static_url,
        guide_is_built=guide.is_built,
        lasted=text.lasted,
        progress_told=text.progress_told,
        held_out_of=held_out_of,
        metric_called=catalogue().metric,
        noise_floor_of=noise_floor_of,
        held_out_columns=held_out_columns,
        held_out_rows=held_out_rows,
    )
    return environment


@lru_cache(maxsize=64)
def _static_url(name: str) -> str:
    """Address of a static file; its digest is in it, so that browsers may keep the file for ever."""
    digest = hashlib.sha256((STATIC / name).read_bytes()).hexdigest()[:12]
    return f"{BASE}/static/{name}?v={digest}"
