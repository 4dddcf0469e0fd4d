"""A world model with everything that its scene needs, as named tensors and plain facts.

Beside the network's tensors (``physworld.worldmodel.model.model``) a version holds, float32 unless said:
    rest.vertices (n, 3)          undeformed places of the object vertices [m]
    particle.index (n,) int64     the twin's particle that each object vertex is
    control.index (C,) int64      the controller that each control vertex is
    phi (n, 2)                    properties after fine-tuning; phi.calibrated (n, 2) before it
    start.history (h+1, n, 3)     object vertices at the first h+1 ticks of the recording [m]
    start.controllers (h+1, K, 3) all controllers at those ticks [m]
    start.time (1,) float64       time of the first of these ticks [s]
    skin.index (N, 8) int64, skin.weight (N, 8)   tracked point = Σ_k weight · vertex[index]
    skin.slope (2, N, 8), skin.offset, skin.line (N, 3)   where tracked points lie beside a sheet or a rope
                                  (``physworld.worldmodel.model.skinning.Beside``); the index is then
                                  skin.beside_index
    phi.strengths.* where the demonstrations varied strengths: ``physworld.worldmodel.model.conditioning``

and the facts (``architecture`` of the card): the ``WorldModelConfig``, ``dt_s``, ``ground_height_m`` (null:
none), ``vertex_spacing_m``, ``edge_radius_m``, ``object_vertices`` n, ``control_vertices`` C, ``edges``, and ``phi``,
the columns of Φ in their order, each with name, unit, whether it is logarithmic, whether the whole body shares it,
and its root mean square over the training episodes; versions without the last have stiffness and density, both
logarithms of ratios. ``strengths`` are the varied strengths, each with its unit, the range that was covered and where
the version stands; none in versions without them. ``grips``: the controllers of each grip; ``holding``: the numbers
of the grips that hold in this version (``physworld.worldmodel.holding``), null where all do, as in versions without it.

A rollout starts with ``start.history`` and ``start.controllers``, or from rest: one frame h+1 times with
still controllers. Its single-precision origin is the mean of the history's last frame; its z is the
ground's height where there is a ground.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from physworld.arrays import Array
from physworld.worldmodel.errors import VersionUnreadable, WorldModelError
from physworld.worldmodel.model.conditioning import Conditioning
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.frame import GripFrame
from physworld.worldmodel.model.graph import EDGE_KINDS, GraphSpec
from physworld.worldmodel.model.inertia import InertialPrior
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.modes import ModeScales
from physworld.worldmodel.model.properties import PhiColumn, columns_of, with_named
from physworld.worldmodel.model.skinning import Beside, Skin
from physworld.worldmodel.native.engine import RolloutEngine
from physworld.worldmodel.priors.chain import ChainPrior, straight
from physworld.worldmodel.priors.modal import ModalPrior
from physworld.worldmodel.rollout import rollout, rollout_batch

CARD_SCHEMA = 1
_OWN = ("rest.", "particle.", "control.", "phi", "start.", "skin.", "graph.")


@dataclass(frozen=True)
class PublishedModel:
    """See the module's text for the arrays. ``others``: models for other sets of grips, published with this one."""

    model: WorldModel
    phi: Array
    phi_calibrated: Array
    start_history: Array
    start_controllers: Array
    start_time_s: float
    skin: Skin
    strengths: Conditioning | None = None
    grips: tuple[tuple[int, ...], ...] = ()
    holding: tuple[int, ...] | None = None
    others: tuple[PublishedModel, ...] = ()

    @property
    def spec(self) -> GraphSpec:
        """The graph."""
        return self.model.spec

    @property
    def columns(self) -> tuple[PhiColumn, ...]:
        """What the columns of Φ stand for."""
        return self.model.columns

    def phi_with(self, named: Mapping[str, float | Array]) -> Array:
        """The fine-tuned Φ (n, 2) with columns replaced by name, each by a number or by (n,)."""
        return with_named(self.columns, self.phi, named)

    def at_strengths(self, named: Mapping[str, float]) -> PublishedModel:
        """The same model at other strengths of effects, by name in their units; the others stay.

        Raises:
            ValueError: a strength that the demonstrations did not vary, or that lies outside of what they covered.
        """
        if self.strengths is None:
            if named:
                raise ValueError(f"there is no strength {min(named)!r}: the demonstrations varied none")
            return self
        model, strengths = self.strengths.moved(self.model, named)
        return replace(self, model=model, strengths=strengths)

    def rollout(
        self,
        controllers: Array,
        *,
        history: Array | None = None,
        phi: Array | Mapping[str, float | Array] | None = None,
    ) -> Array:
        """Object vertices (T, n, 3) [m] for controllers (T, K, 3) at ticks from the start's first one.

        ``phi``: (n, 2), or columns of it by name; by default as fine-tuned.
        """
        return rollout(
            self.model,
            self.spec,
            self.start_history if history is None else history,
            controllers,
            self._phi(phi),
        )

    @cached_property
    def engine(self) -> RolloutEngine:
        """The weights, prepared once for every rollout that follows."""
        return RolloutEngine(self.model)

    def rollout_batch(
        self,
        controllers: Array,
        *,
        history: Array | None = None,
        phi: Array | Mapping[str, float | Array] | None = None,
        threads: int = 1,
    ) -> Array:
        """Object vertices of every candidate [m], (B, T, n, 3).

        Args:
            controllers: (B, T, K, 3) [m]; candidates share their first h+1 ticks.
            history: object vertices at these ticks [m], (h+1, n, 3); by default the recording's.
            phi: (n, 2) or (B, n, 2), or columns by name; by default as fine-tuned.
            threads: that share the candidates.
        """
        return rollout_batch(
            self.engine,
            self.spec,
            self.start_history if history is None else history,
            controllers,
            self._phi(phi),
            threads=threads,
        )

    def _phi(self, phi: Array | Mapping[str, float | Array] | None) -> Array:
        if phi is None:
            return self.phi
        return self.phi_with(phi) if isinstance(phi, Mapping) else phi

    def to_tensors(self) -> dict[str, Array]:
        """Every array by its published name."""
        spec = self.spec
        single = {
            "graph.rest_relative": spec.rest_relative,
            "rest.vertices": spec.rest_vertices,
            "phi": self.phi,
            "phi.calibrated": self.phi_calibrated,
            "start.history": self.start_history,
            "start.controllers": self.start_controllers,
            "skin.weight": self.skin.weight,
        }
        whole = {
            _table_name(spec.current_neighbours, spec.frame is not None): spec.neighbours,
            "graph.edge_kind": spec.edge_kind,
            "particle.index": spec.particle_index,
            "control.index": spec.control_index,
            _skin_index(self.skin.beside is not None): self.skin.index,
        }
        if spec.frame is not None:
            single |= {
                "graph.frame_shape": spec.frame.shape,
                "graph.frame_fall": spec.frame.fall,
                "graph.frame_line": spec.frame.line,
            }
        if self.skin.beside is not None:
            single |= {f"skin.{name}": value for name, value in vars(self.skin.beside).items()}
        if spec.current_neighbours:
            whole["graph.current_neighbours"] = np.array([spec.current_neighbours])
        network = {name: value.numpy(force=True) for name, value in self.model.state_dict().items()}
        if np.any(network.get("prior.natural", 0.0)):
            network[_COILED] = network.pop("prior.curve")
        if self.model.modes is not None:
            network[_BESIDE_MODES] = network.pop("skip.weight")
        return (
            {name: np.ascontiguousarray(value) for name, value in network.items()}
            | {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in single.items()}
            | {name: np.ascontiguousarray(value, dtype=np.int64) for name, value in whole.items()}
            | {"start.time": np.array([self.start_time_s], dtype=np.float64)}
            | ({} if self.strengths is None else self.strengths.to_tensors())
        )

    def facts(self) -> dict[str, Any]:
        """The ``architecture`` of the card."""
        spec = self.spec
        return asdict(self.model.config) | {
            "dt_s": spec.dt_s,
            "ground_height_m": spec.ground_height_m,
            "vertex_spacing_m": spec.vertex_spacing_m,
            "edge_radius_m": spec.edge_radius_m,
            "object_vertices": spec.object_count,
            "control_vertices": spec.control_count,
            "edges": spec.edge_count,
            "frame": "world" if spec.frame is None else "grip",
            "mapped_modes": 0 if self.model.modes is None else len(self.model.modes.shapes),
            "phi": [
                one.described(float(spread))
                for one, spread in zip(self.columns, self.model.norm.properties, strict=True)
            ],
            "strengths": [] if self.strengths is None else self.strengths.facts(),
            "grips": [list(own) for own in self.grips],
            "holding": None if self.holding is None else list(self.holding),
        }

    @classmethod
    def from_tensors(cls, tensors: dict[str, Array], facts: dict[str, Any]) -> PublishedModel:
        """The inverse of :meth:`to_tensors` and :meth:`facts`. Raises VersionUnreadable for any other layout."""
        try:
            return cls._read(tensors, _FACTS_BEFORE | facts)
        except KeyError as error:
            raise VersionUnreadable(f"it lacks {error}") from error
        except (TypeError, ValueError, IndexError, RuntimeError, WorldModelError) as error:
            raise VersionUnreadable(f"its parts do not fit together: {error}") from error

    @classmethod
    def from_card(cls, tensors: dict[str, Array], card: dict[str, Any]) -> PublishedModel:
        """The model of a version's tensors and its card.

        Raises:
            VersionUnreadable: it has another layout; the message says which, who wrote it, and what to do.
        """
        layout, writer = card.get("schema_version", CARD_SCHEMA), card.get("versions", {}).get("physworld")
        try:
            if layout != CARD_SCHEMA:
                raise VersionUnreadable(f"cards of layout {CARD_SCHEMA} are read here")
            return cls.from_tensors(tensors, card.get("architecture", {}))
        except VersionUnreadable as error:
            raise VersionUnreadable(
                f"{error} (published by {writer or 'an unknown version of physworld'} with a card of layout "
                f"{layout}). Train it anew from its dataset ({card.get('dataset_id') or 'POST /v1/models'})"
            ) from error

    @classmethod
    def _read(cls, tensors: dict[str, Array], facts: dict[str, Any]) -> PublishedModel:
        if "prior.spread" in tensors:  # chains of earlier versions are straight
            held = straight(len(tensors["prior.mass"]))
            tensors = {f"prior.{name}": value for name, value in held.items()} | tensors
        own_names = {_COILED: "prior.curve", _BESIDE_MODES: "skip.weight"}
        tensors = {own_names.get(name, name): value for name, value in tensors.items()}
        names = WorldModelConfig.__dataclass_fields__
        config = WorldModelConfig(**{name: facts[name] for name in names})
        current = int(tensors["graph.current_neighbours"][0]) if config.near_edges == "current" else 0
        spec = GraphSpec(
            dt_s=facts["dt_s"],
            rest_vertices=tensors["rest.vertices"].astype(np.float64),
            particle_index=tensors["particle.index"],
            control_index=tensors["control.index"],
            neighbours=tensors[_table_name(current, "graph.frame_shape" in tensors)],
            edge_kind=tensors["graph.edge_kind"],
            rest_relative=tensors["graph.rest_relative"].astype(np.float64),
            vertex_spacing_m=facts["vertex_spacing_m"],
            edge_radius_m=facts["edge_radius_m"],
            ground_height_m=facts["ground_height_m"],
            current_neighbours=current,
            frame=_frame_of(tensors),
        )
        prior = _prior_of(tensors)
        _refuse_other_sizes(tensors, prior, config, spec)
        columns = columns_of(facts.get("phi"))
        model = WorldModel(config, spec, prior=prior, columns=columns, modes=_modes_of(tensors))
        network = {name: value for name, value in tensors.items() if not name.startswith(_OWN)}
        model.load_state_dict({name: torch.as_tensor(value) for name, value in network.items()})
        return cls(
            model=model,
            phi=tensors["phi"].astype(np.float64),
            phi_calibrated=tensors["phi.calibrated"].astype(np.float64),
            start_history=tensors["start.history"].astype(np.float64),
            start_controllers=tensors["start.controllers"].astype(np.float64),
            start_time_s=float(tensors["start.time"][0]),
            skin=_skin_of(tensors),
            strengths=Conditioning.read(tensors, facts.get("strengths")),
            grips=tuple(tuple(own) for own in facts.get("grips", ())),
            holding=None if facts.get("holding") is None else tuple(facts["holding"]),
        )


_COILED = (
    "prior.coiled_curve"  # ``prior.curve`` of a coiled chain: a reader that does not know of coils finds none
)
_BESIDE_MODES = "skip.beside_modes.weight"  # ``skip.weight`` beside a linear map of modes: the same
_FACTS_BEFORE = {"near_edges": "material"}  # what versions were that do not say it


def _table_name(current_neighbours: int, framed: bool) -> str:
    """Tensor of the edges that are kept: another name where the NEAR ones are not among them or where a step is taken
    in the grip's frame, so that a reader that does not know of it finds none."""
    if framed:
        return "graph.turned_neighbours"
    return "graph.kept_neighbours" if current_neighbours else "graph.neighbours"


def _skin_index(beside: bool) -> str:
    """Tensor of the vertices that carry points: another name where these lie beside them, so that a reader that does
    not know of it finds none."""
    return "skin.beside_index" if beside else "skin.index"


def _skin_of(tensors: dict[str, Array]) -> Skin:
    """How vertices carry the tracked points. Raises KeyError, ValueError for tensors that do not fit together."""
    index, weight = tensors[_skin_index("skin.slope" in tensors)], tensors["skin.weight"].astype(np.float64)
    if "skin.slope" not in tensors:
        return Skin(index, weight)
    slope, offset, line = (tensors[f"skin.{name}"].astype(np.float64) for name in ("slope", "offset", "line"))
    return Skin(index, weight, Beside(slope, offset, line))


def _frame_of(tensors: dict[str, Array]) -> GripFrame | None:
    """The grip's frame, None where a step is taken in world axes."""
    if "graph.frame_shape" not in tensors:
        return None
    parts = {name: tensors[f"graph.frame_{name}"].astype(np.float64) for name in ("shape", "fall", "line")}
    if not np.any(parts["shape"]):
        raise ValueError("graph.frame_shape of points that are all in one place")
    return GripFrame(**parts)


def _prior_of(tensors: dict[str, Array]) -> ModalPrior | ChainPrior | InertialPrior:
    """The prior whose tensors there are."""
    if "prior.lags" in tensors:
        return InertialPrior(len(tensors["rest.vertices"]))
    if "prior.spread" not in tensors:
        return ModalPrior(**{part: tensors[f"prior.{part}"] for part in ModalPrior.__dataclass_fields__})
    parts: dict[str, Any] = {part: tensors[f"prior.{part}"] for part in ChainPrior.__dataclass_fields__}
    parts["substeps"] = int(parts["substeps"][0])
    return ChainPrior(**parts)


def _modes_of(tensors: dict[str, Array]) -> ModeScales | None:
    """The linear map of modes beside the network, where there is one."""
    if "modes.shapes" not in tensors:
        return None
    return ModeScales(**{name: tensors[f"modes.{name}"] for name in ModeScales.__dataclass_fields__})


def _refuse_other_sizes(
    tensors: dict[str, Array],
    prior: ModalPrior | ChainPrior | InertialPrior,
    config: WorldModelConfig,
    spec: GraphSpec,
) -> None:
    """Raises ValueError where arrays are not of the graph's sizes: what rolls out reads them by these."""
    n, controls, frames = spec.object_count, spec.control_count, config.history + 1
    table = _table_name(spec.current_neighbours, spec.frame is not None)
    slots = (spec.vertex_count, spec.neighbours.shape[1])
    expected = {"phi": (n, 2), "phi.calibrated": (n, 2), "start.history": (frames, n, 3)}
    expected |= {"rest.vertices": (n, 3), "particle.index": (n,), "control.index": (controls,)}
    expected |= {table: slots, "graph.edge_kind": slots, "graph.rest_relative": (*slots, 3)}
    expected["start.controllers"] = (frames, tensors["start.controllers"].shape[1], 3)
    carried, points = _skin_index("skin.slope" in tensors), len(tensors["skin.weight"])
    expected[carried] = tensors["skin.weight"].shape
    if "skin.slope" in tensors:
        expected |= {
            "skin.slope": (2, *expected[carried]),
            "skin.offset": (points, 3),
            "skin.line": (points, 3),
        }
    if spec.frame is not None:
        expected |= {"graph.frame_shape": (controls, 3), "graph.frame_fall": (3,), "graph.frame_line": (3,)}
    if "modes.shapes" in tensors:
        shapes, width = len(tensors["modes.shapes"]), 3 * (frames + 1)
        inputs = width * (shapes + controls)
        expected |= {
            "modes.shapes": (shapes, n),
            "modes.change": (shapes,),
            "modes.weight": (inputs, 3 * shapes),
        }
        expected |= {"modes.middle": (inputs,), "modes.scale": (inputs,)}
    if isinstance(prior, ModalPrior):
        modes = len(prior.basis)
        expected["prior.mean"] = (n, 3)
        expected["prior.shape"] = (controls, 3)
        expected["prior.response"] = (2, modes, frames * modes + 1)
    elif isinstance(prior, ChainPrior):
        expected["prior.spread"] = (n, len(prior.mass))
        expected["prior.anchor"] = (len(prior.markers), controls)
    for name, shape in expected.items():
        if tensors[name].shape != shape:
            raise ValueError(f"{name} {tensors[name].shape}, not {shape}")
    for name, values in tensors.items():
        if np.issubdtype(values.dtype, np.floating) and np.isnan(values).any():
            raise ValueError(
                f"{name} with {int(np.isnan(values).sum())} of {values.size} values not a number"
            )
    most = {carried: n, "control.index": tensors["start.controllers"].shape[1]}
    most |= {table: spec.vertex_count + 1, "graph.edge_kind": EDGE_KINDS}
    for name, end in most.items():
        if tensors[name].max(initial=0) >= end:
            raise ValueError(f"{name} {tensors[name].max()}, of {end}")
    for name in (*most, "particle.index"):
        if tensors[name].min(initial=0) < 0:
            raise ValueError(f"{name} {tensors[name].min()}, below 0")
    if not 0 <= spec.current_neighbours < n:
        raise ValueError(f"graph.current_neighbours {spec.current_neighbours}, of {n}")
