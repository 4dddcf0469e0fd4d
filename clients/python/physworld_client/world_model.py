"""A published world model without the service: load a downloaded version, roll it out on NumPy arrays.

    model = WorldModel.load("models/beam-1")
    vertices = model.rollout(controllers)      # (T, n, 3) from (T, K, 3), model.dt_s apart
    points = model.track(vertices)             # (T, N, 3), the scene's measured points

Signature and digests are checked before anything of the files is read. Needs numpy, safetensors and cryptography. The
tensors and their meaning: ``physworld.worldmodel.model.model`` and ``physworld.worldmodel.published``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file

from physworld_client.errors import ModelUnreadable
from physworld_client.known_keys import trusted_keys
from physworld_client.manifest import CARD_NAME, WEIGHTS_NAME, verify_folder
from physworld_client.network import OPPOSITE, PROPERTY_COUNT, Network
from physworld_client.types import Array
from physworld_schemas.arrays import FARTHEST_M
from physworld_schemas.wording import reason

CARD_SCHEMA = 1
PHI_NAMES = ("stiffness", "density")
"""Columns of Φ, which the weights take in this order."""
_SHORTEST = 1e-12  # of a direction: shorter ones are none


@dataclass(frozen=True, repr=False)
class WorldModel:
    """A loaded version. Positions in metres, world frame z up; the clock ticks every ``dt_s`` seconds.

    Attributes:
        name, version: of the registry.
        card: the model card: lineage, metrics, versions, seeds.
        dt_s: the model's time step [s].
        start_history: object vertices at the first h+1 ticks of the recording, (h+1, n, 3).
        start_controllers: all controllers at these ticks, (h+1, K, 3).
        start_time_s: time of the first of them in the recording [s].
        rest_vertices: undeformed places of the object vertices, (n, 3).
        control_index: the controller that each control vertex is, (C,).
        phi: log property ratios after fine-tuning, (n, 2).
        phi_calibrated: before it, (n, 2).
        phi_names: names of the columns of Φ.
        ground_height_m: height of the ground plane, None without one.
    """

    name: str
    version: int
    card: dict[str, Any]
    dt_s: float
    start_history: Array
    start_controllers: Array
    start_time_s: float
    rest_vertices: Array
    control_index: Array
    phi: Array
    phi_calibrated: Array
    phi_names: tuple[str, ...]
    ground_height_m: float | None
    _network: Network
    _skin: tuple[Array, Array] | None
    _beside: tuple[Array, ...] | None

    def __repr__(self) -> str:
        return (
            f"WorldModel({self.name!r}, version={self.version}, vertices={len(self.rest_vertices)}, "
            f"controllers={self.controller_count}, history={self.history}, dt_s={self.dt_s:g})"
        )

    @classmethod
    def load(
        cls,
        folder: str | Path,
        *,
        sha256: str | None = None,
        public_key: str | Path | None = None,
        allow_unsigned: bool = False,
        known_keys: str | Path | None = None,
    ) -> WorldModel:
        """Loads a folder written by ``client.models.download``.

        Args:
            sha256: the version's digest, when known from elsewhere; the folder must be exactly that version.
            public_key: the only key that may have signed it, in base64 or as the ``Path`` of a file; by default any
                that is pinned on this machine (``physworld_client.known_keys``).
            allow_unsigned: load without looking at the signature (a version published before there were any).
            known_keys: the file of pinned keys; by default that of this machine.

        Raises:
            SigningKeyUntrusted: another key signed than those that are trusted.
            SignatureInvalid: the manifest is not signed, or was changed since.
            DigestMismatch: a file is not the published one.
            ModelUnreadable: a file is missing, or the artifact has a layout that this client does not know.
        """
        place = Path(folder)
        manifest = verify_folder(place, sha256, keys=trusted_keys(public_key, allow_unsigned, known_keys))
        missing = [name for name in (WEIGHTS_NAME, CARD_NAME) if name not in manifest.files]
        if missing:
            raise ModelUnreadable(f"the manifest in {place} lists no {' and no '.join(missing)}")
        try:
            tensors = load_file(place / WEIGHTS_NAME)
            card = json.loads((place / CARD_NAME).read_bytes())
            known, facts = card["schema_version"] == CARD_SCHEMA, card["architecture"]
            dt_s, ground = float(facts["dt_s"]), facts["ground_height_m"]
        except (SafetensorError, ValueError, KeyError, TypeError) as error:
            raise ModelUnreadable(
                f"{place} is not a world model of a known layout: {reason(error)}"
            ) from error
        if not known:
            raise ModelUnreadable(
                f"{place} is not a world model of a known layout: its card has schema_version "
                f"{card['schema_version']}, this client reads {CARD_SCHEMA}"
            )
        return cls._assemble(manifest.name, manifest.version, card, dt_s, ground, tensors)

    @classmethod
    def _assemble(
        cls,
        name: str,
        version: int,
        card: dict[str, Any],
        dt_s: float,
        ground_height_m: float | None,
        tensors: Mapping[str, Array],
    ) -> WorldModel:
        """The model of verified tensors."""

        def tensor(key: str) -> Array:
            if key not in tensors:
                raise ModelUnreadable(f"{name} version {version} lacks the tensor {key!r}")
            return tensors[key]

        rest = tensor("rest.vertices").astype(np.float64)
        network = Network(tensors, len(rest))
        if network.has_ground != (ground_height_m is not None):
            raise ModelUnreadable(
                f"{name} version {version}: ground height {ground_height_m} against its weights"
            )
        skin = None
        index = "skin.beside_index" if "skin.slope" in tensors else "skin.index"
        if index in tensors:
            skin = (tensors[index], tensor("skin.weight").astype(np.float64))
        beside = None
        if skin is not None and "skin.slope" in tensors:
            beside = tuple(tensor(f"skin.{part}").astype(np.float64) for part in ("slope", "offset", "line"))
        return cls(
            name=name,
            version=version,
            card=card,
            dt_s=dt_s,
            start_history=tensor("start.history").astype(np.float64),
            start_controllers=tensor("start.controllers").astype(np.float64),
            start_time_s=float(tensor("start.time")[0]),
            rest_vertices=rest,
            control_index=tensor("control.index"),
            phi=tensor("phi").astype(np.float64),
            phi_calibrated=tensor("phi.calibrated").astype(np.float64),
            phi_names=_phi_names(name, version, card),
            ground_height_m=ground_height_m,
            _network=network,
            _skin=skin,
            _beside=beside,
        )

    @property
    def history(self) -> int:
        """h: a step looks back so many ticks."""
        history: int = self._network.history
        return history

    @property
    def controller_count(self) -> int:
        """K, the controllers of the scene."""
        return int(self.start_controllers.shape[1])

    def rollout(
        self,
        controllers: Array,
        phi: Array | Mapping[str, float | Array] | None = None,
        *,
        history: Array | None = None,
    ) -> Array:
        """Object vertices over time [m], (T, n, 3); the first h+1 frames are the history itself.

        Args:
            controllers: all controllers at T ticks [m], (T, K, 3); the first h+1 belong to the history.
            phi: log property ratios, (n, 2), or some of its columns by name, each a number or (n,): ``{"stiffness":
                np.log(2)}`` is twice the calibrated stiffness. What is not given is that of the fine-tuning.
            history: object vertices at the first h+1 ticks [m], (h+1, n, 3); by default the recording's.
                From rest: one frame h+1 times, with controllers that stand still as long.

        Raises:
            ValueError: a name that is no column of Φ, arrays of other shapes, values that are not finite, places
                beyond ``FARTHEST_M``.
        """
        frames, n = self.history + 1, self._network.object_count
        start = self.start_history if history is None else np.asarray(history, dtype=np.float64)
        driven = np.asarray(controllers, dtype=np.float64)
        properties = self._phi(phi)
        if driven.ndim != 3 or driven.shape[1:] != (self.controller_count, 3) or len(driven) < frames:
            raise ValueError(f"controllers {driven.shape}, not (T >= {frames}, {self.controller_count}, 3)")
        if start.shape != (frames, n, 3) or properties.shape != (n, PROPERTY_COUNT):
            raise ValueError(
                f"history {start.shape} and phi {properties.shape}, not {(frames, n, 3)} and "
                f"{(n, PROPERTY_COUNT)}"
            )
        broken = sum(np.count_nonzero(~np.isfinite(part)) for part in (driven, start, properties))
        if broken:
            raise ValueError(f"{broken} values of controllers, history and phi are no finite numbers")
        farthest = max(float(np.abs(part).max()) for part in (driven, start))
        if farthest > FARTHEST_M:
            raise ValueError(
                f"a place {farthest:.4g} m from the origin in controllers or history; {FARTHEST_M:g} m is the farthest"
            )
        origin = start[-1].mean(axis=0)
        if self.ground_height_m is not None:
            origin[2] = self.ground_height_m
        controls = driven[:, self.control_index] - origin
        path = np.empty((len(driven), n + len(self.control_index), 3))
        path[:frames, :n] = start - origin
        path[:, n:] = controls
        for tick in range(frames, len(driven)):
            path[tick] = self._network.step(path[tick - frames : tick], controls[tick], properties)
        vertices: Array = path[:, :n] + origin
        return vertices

    def _phi(self, given: Array | Mapping[str, float | Array] | None) -> Array:
        """Φ (n, 2) of what a caller gave."""
        if given is None:
            return self.phi
        if not isinstance(given, Mapping):
            return np.asarray(given, dtype=np.float64)
        phi = self.phi.copy()
        for name, values in given.items():
            if name not in self.phi_names:
                raise ValueError(f"Φ has no column {name!r}; it has {', '.join(self.phi_names)}")
            phi[:, self.phi_names.index(name)] = values
        return phi

    def track(self, vertices: Array) -> Array:
        """The scene's measured points that vertices (T, n, 3) carry [m], (T, N, 3)."""
        if self._skin is None:
            raise ModelUnreadable(f"{self.name} version {self.version} carries no measured points")
        index, weight = self._skin
        places = np.asarray(vertices)
        points = _combined(weight, index, places)
        if self._beside is not None:
            slope, offset, line = self._beside
            along, across = (_combined(part, index, places) for part in slope)
            if np.any(line):
                points += _turned(offset, line, along)
            else:
                points += offset[:, 2:] * _unit(np.cross(along, across))
        return points


def _combined(weight: Array, index: Array, places: Array) -> Array:
    """Σ_k weight_k x_k (…, M, 3), one neighbour at a time: all at once take K times the memory."""
    total: Array = weight[:, :1] * places[..., index[:, 0], :]
    for k in range(1, index.shape[1]):
        total += weight[:, k, None] * places[..., index[:, k], :]
    return total


def _unit(vectors: Array) -> Array:
    found: Array = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), _SHORTEST)
    return found


def _turned(offset: Array, line: Array, along: Array) -> Array:
    """Offsets (M, 3) beside a rope, turned as the least turns take ``line`` (M, 3) to ``along`` (…, M, 3)."""
    goal = _unit(along)
    axis = np.cross(line, goal)
    once = np.cross(axis, offset)
    near = np.maximum(1.0 + (line * goal).sum(axis=-1, keepdims=True), OPPOSITE)
    turned: Array = offset + once + np.cross(axis, once) / near
    return turned


def _phi_names(name: str, version: int, card: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the columns of Φ; cards of earlier releases do not list them."""
    listed = card["architecture"].get("phi")
    names = PHI_NAMES if listed is None else tuple(str(column["name"]) for column in listed)
    if names != PHI_NAMES:
        raise ModelUnreadable(
            f"{name} version {version}: Φ has the columns {', '.join(names)}, this client knows {', '.join(PHI_NAMES)}"
        )
    return names
