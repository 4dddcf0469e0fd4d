"""Published models, loaded once and kept while they are used: the least recently used one goes first."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict

from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors

from physworld.worldmodel.errors import VersionUnreadable
from physworld.worldmodel.holding.rollout import with_others
from physworld.worldmodel.published import PublishedModel
from physworld_schemas.fit import Fit
from physworld_schemas.model import ModelVersion
from physworld_schemas.trace import Trace
from physworld_storage import registry, resources, traces
from physworld_storage.artifacts import ArtifactStore
from physworld_storage.database import Database
from physworld_storage.errors import Conflict, NotFound

KEPT_MODELS = 4


class Models:
    """Versions by their manifest's digest; safe between threads."""

    def __init__(self, database: Database, artifacts: ArtifactStore, kept: int = KEPT_MODELS) -> None:
        self._database, self._artifacts, self._most = database, artifacts, kept
        self._kept: OrderedDict[str, PublishedModel] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, name: str, version: int | str) -> tuple[ModelVersion, PublishedModel]:
        """The version and its network.

        Raises NotFound, Conflict when it is not ready, ArtifactCorrupt, VersionUnreadable.
        """
        with self._database.reading() as session:
            found = registry.get_version(session, name, version)
        if found.state != "ready" or found.sha256 is None:
            raise Conflict(
                f"version {found.version} of {name} is {found.state}; a rollout needs a ready version"
            )
        with self._lock:  # one at a time: two loads of one model would take twice its memory
            model = self._kept.get(found.sha256)
            if model is None:
                model = self._kept[found.sha256] = self._load(found)
                while len(self._kept) > self._most:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(found.sha256)
        return found, model

    def twin(self, version: ModelVersion) -> bytes:
        """The npz of the twin that a version learned from: its trace's where that added an effect, else its fit's.

        Raises NotFound where it is gone.
        """
        with self._database.reading() as session:
            if version.fit_id is None:
                raise NotFound("fit of model version", f"{version.name}:{version.version}")
            owner: Fit | Trace = resources.get_fit(session, version.fit_id)
            if version.trace_id is not None:
                trace = traces.get_trace(session, version.trace_id)
                owner = trace if traces.leaves_twin(trace) else owner
        found = next((item.sha256 for item in owner.artifacts if item.name == "twin.npz"), None)
        if found is None:
            raise NotFound("artifact", f"twin.npz of {owner.id}")
        return self._artifacts.read_bytes(found)

    def _load(self, version: ModelVersion) -> PublishedModel:
        files = {item.name: item.sha256 for item in version.artifacts}
        for name in ("card.json", "model.safetensors"):
            if name not in files:
                raise NotFound("artifact", f"{name} of {version.name}:{version.version}")
        try:
            card = json.loads(self._artifacts.read_bytes(files["card.json"]))
            tensors = load_tensors(self._artifacts.read_bytes(files["model.safetensors"]))
            return with_others(
                tensors, card, lambda name: load_tensors(self._artifacts.read_bytes(files[name]))
            )
        except (ValueError, SafetensorError) as error:  # as they were published: their digests are theirs
            raise VersionUnreadable(f"its files are of another format: {error}") from error
