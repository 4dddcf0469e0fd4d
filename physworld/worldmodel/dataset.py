"""Episodes as training data: the vertices' tracks, their scales, and batches of sub-sequences.

An episode's arrays: ``times`` (T,) [s], ``particles`` (T, P, 3) [m], ``controllers`` (T, K, 3) [m],
``properties`` (P, 2) = log(E/E_fit), log(ρ/ρ_fit), and log(μ/μ_fit) as a third where the ground's friction was
perturbed. A stored episode may keep ``vertices`` (T, M, 3), the particles ``vertex_index`` (M,), beside or
instead of the particles, and where grips let go ``holding`` (T, G) (``physworld.worldmodel.holding.spans``).
Everything random comes from the ``torch.Generator`` that is passed in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from physworld.arrays import Array
from physworld.worldmodel.errors import DatasetUnusable
from physworld.worldmodel.model.features import Normalisation, cut_rest_length, cut_strain
from physworld.worldmodel.model.frame import turn_of
from physworld.worldmodel.model.graph import EDGE_KINDS, NEAR, GraphSpec
from physworld.worldmodel.model.nearest import near_ends
from physworld.worldmodel.model.properties import EPISODE_FIELDS, PROPERTIES, PhiColumn

SCALE_FLOOR_M = 1e-7
PROPERTY_FLOOR = 0.05
CLOCK_TOLERANCE = 1e-3
VERTEX_ARRAYS = ("times", "controllers", "holding", "properties", "vertex_index", "vertices")
Episode = TypeVar("Episode")


@dataclass(frozen=True)
class Track:
    """One episode seen by the graph: ``positions`` (T, V, 3) float32 from ``graph_origin``, ``phi`` (n, 2 + m)."""

    positions: Tensor
    phi: Tensor


@dataclass(frozen=True)
class Batch:
    """Sub-sequences: ``positions`` (h+1+τ, V, B, 3) and ``phi`` (n, B, 2)."""

    positions: Tensor
    phi: Tensor


def graph_origin(spec: GraphSpec, vertices: Array) -> Array:
    """Where single precision counts from, (3,): the vertices' mean (…, n, 3), with z at the ground if there
    is one.
    """
    origin: Array = np.asarray(vertices, dtype=np.float64).reshape(-1, 3).mean(axis=0)
    if spec.ground_height_m is not None:
        origin[2] = spec.ground_height_m
    return origin


def read_track(
    spec: GraphSpec,
    arrays: dict[str, Array],
    history: int,
    columns: Sequence[PhiColumn] = PROPERTIES,
    values: Mapping[str, float] | None = None,
) -> Track:
    """The graph's vertices of an episode.

    Args:
        spec: the graph.
        arrays: the episode's, see the module's text.
        history: h.
        columns: of Φ; what the episode holds as a field (``EPISODE_FIELDS``) is read by place.
        values: the others by name, one number each.

    Raises:
        DatasetUnusable: with the numbers.
    """
    times, controllers = arrays["times"], arrays["controllers"]
    frames = len(times)
    if frames < history + 2:
        raise DatasetUnusable(f"an episode of {frames} frames is shorter than history {history} + 2")
    step = float(times[-1] - times[0]) / (frames - 1)
    if abs(step - spec.dt_s) > CLOCK_TOLERANCE * spec.dt_s:
        raise DatasetUnusable(
            f"an episode's frames are {step:.6g} s apart, the model's clock is {spec.dt_s:.6g} s"
        )
    if has_vertices(spec, arrays):
        body = arrays["vertices"][:, : spec.object_count]
    elif "particles" not in arrays or arrays["particles"].shape[1] <= int(spec.particle_index.max()):
        raise DatasetUnusable(
            f"an episode of {len(arrays['properties'])} particles is of another body: the graph has particle "
            f"{int(spec.particle_index.max())}"
        )
    else:
        body = arrays["particles"][:, spec.particle_index]
    vertices = np.concatenate([body, controllers[:, spec.control_index]], axis=1, dtype=np.float64)
    properties = np.asarray(arrays["properties"], dtype=np.float64)[spec.particle_index]
    fields = dict(zip(EPISODE_FIELDS, properties.T, strict=False))
    phi = np.empty((len(properties), len(columns)))
    for k, column in enumerate(columns):
        phi[:, k] = fields[column.name] if column.name in fields else (values or {})[column.name]
    if not (np.isfinite(vertices).all() and np.isfinite(phi).all()):
        raise DatasetUnusable("an episode holds values that are not finite")
    vertices -= graph_origin(spec, vertices[0, : spec.object_count])
    return Track(torch.as_tensor(vertices, dtype=torch.float32), torch.as_tensor(phi, dtype=torch.float32))


def has_vertices(spec: GraphSpec, arrays: dict[str, Array]) -> bool:
    """Whether an episode keeps the graph's vertices apart from its other particles (``VERTEX_ARRAYS``)."""
    kept = arrays.get("vertex_index")
    return kept is not None and np.array_equal(kept[: spec.object_count], spec.particle_index)


def split_tracks(episodes: list[Episode], fraction: float, seed: int) -> tuple[list[Episode], list[Episode]]:
    """Training and validation episodes, whole; at least one of each, the same one when there is only one."""
    if len(episodes) == 1:
        return episodes, episodes
    held_out = min(max(1, round(fraction * len(episodes))), len(episodes) - 1)
    order = np.random.default_rng(seed).permutation(len(episodes))
    return [episodes[i] for i in order[held_out:]], [episodes[i] for i in order[:held_out]]


def measure_scales(
    tracks: list[Track], spec: GraphSpec, residual: Callable[[Track], Tensor]
) -> Normalisation:
    """Root-mean-square scales over all frames of all object vertices and edges.

    ``residual`` gives what the modal prior leaves of a track's steps [m], (…, n, 3).
    """
    n = spec.object_count
    squares: dict[str, float] = {}
    for track in tracks:
        x = track.positions
        turns = None if spec.frame is None else turn_of(spec.frame, x[:, n:].transpose(0, 1))[0]
        _add(squares, "velocity", x[1:, :n] - x[:-1, :n])
        _add(squares, "change", residual(track))
        for kind in range(EDGE_KINDS):
            if kind == NEAR and spec.current_neighbours:
                for name, values in _current_scales(x, spec).items():
                    _add(squares, f"{name}{kind}", values)
                continue
            taken = (spec.neighbours < spec.vertex_count) & (spec.edge_kind == kind)
            rest = torch.as_tensor(spec.rest_relative[taken], dtype=torch.float32)
            relative = x[:, spec.neighbours[taken]] - x[:, np.nonzero(taken)[0]]
            turned = relative if turns is None else relative @ turns
            stretch = torch.linalg.vector_norm(relative, dim=-1) - torch.linalg.vector_norm(rest, dim=-1)
            _add(squares, f"relative{kind}", relative[1:] - relative[:-1])
            _add(squares, f"strain{kind}", turned - rest)
            _add(squares, f"stretch{kind}", stretch)
    scales = {name: max((total / len(tracks)) ** 0.5, SCALE_FLOOR_M) for name, total in squares.items()}
    spread = torch.stack([track.phi for track in tracks]).square().mean(dim=(0, 1)).sqrt()
    by_kind = {
        name: tuple(scales[f"{name}{kind}"] for kind in range(EDGE_KINDS))
        for name in ("relative", "strain", "stretch")
    }
    return Normalisation(
        velocity=scales["velocity"],
        change=scales["change"],
        properties=tuple(max(float(value), PROPERTY_FLOOR) for value in spread),
        **by_kind,
    )


def _current_scales(x: Tensor, spec: GraphSpec) -> dict[str, Tensor]:
    """The same of the NEAR edges that each frame of a track (T, V, 3) has, as the network sees them."""
    n, radius = spec.object_count, spec.edge_radius_m
    frame, receiver, sender = near_ends(x[:, :n].numpy(), spec.current_neighbours, radius)
    rest = torch.as_tensor(spec.rest_vertices[sender] - spec.rest_vertices[receiver], dtype=torch.float32)
    relative = x[frame, sender] - x[frame, receiver]
    before = np.maximum(frame - 1, 0)
    moved = relative - (x[before, sender] - x[before, receiver])
    rest_length = cut_rest_length(torch.linalg.vector_norm(rest, dim=-1), radius)
    return {
        "relative": moved[torch.as_tensor(frame > 0)],
        "strain": cut_strain(relative - rest, radius),
        "stretch": torch.linalg.vector_norm(relative, dim=-1) - rest_length,
    }


class WindowSampler:
    """Draws batches of sub-sequences uniformly over all starts of all episodes."""

    def __init__(self, tracks: list[Track]) -> None:
        self.positions = torch.cat([track.positions for track in tracks])
        self.phi = torch.stack([track.phi for track in tracks])
        self.lengths = [track.positions.shape[0] for track in tracks]
        self._starts: dict[int, tuple[Tensor, Tensor]] = {}

    def draw(self, frames: int, count: int, generator: torch.Generator) -> Batch:
        """``count`` sub-sequences of ``frames`` frames."""
        starts, owners = self._windows(frames)
        pick = torch.randint(len(starts), (count,), generator=generator)
        rows = starts[pick][None] + torch.arange(frames)[:, None]
        positions = self.positions[rows].transpose(1, 2).contiguous()
        return Batch(positions, self.phi[owners[pick]].transpose(0, 1).contiguous())

    def _windows(self, frames: int) -> tuple[Tensor, Tensor]:
        """First rows and episodes of all windows of that length."""
        if frames not in self._starts:
            starts, owners, offset = [], [], 0
            for episode, length in enumerate(self.lengths):
                count = max(0, length - frames + 1)
                starts.append(offset + torch.arange(count))
                owners.append(torch.full((count,), episode))
                offset += length
            joined = torch.cat(starts)
            if not len(joined):
                raise DatasetUnusable(f"no episode is as long as a training window of {frames} frames")
            self._starts[frames] = (joined, torch.cat(owners))
        return self._starts[frames]


def _add(squares: dict[str, float], name: str, values: Tensor) -> None:
    """Add the mean square of ``values`` to that name's total; nothing where there are no values."""
    mean = float(values.double().square().mean()) if values.numel() else 0.0
    squares[name] = squares.get(name, 0.0) + mean
