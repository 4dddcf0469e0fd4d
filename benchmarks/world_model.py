"""World model: rollout steps per second and training milliseconds per sample, on one thread.

    python -m benchmarks.world_model [--json FILE] [--repeats N] [--seed N]

One graph of 150 vertices and about 1950 directed edges, 7 message passing steps, hidden 64 and 128. Beside ours:

* ``pyg``: the usual interaction network (edge and vertex MLPs of two layers on concatenated states) as a PyTorch
  Geometric ``MessagePassing``, eager, on the same graph and features;
* ``pytorch_naive``: our own function written the plain way (``physworld.worldmodel.naive``), eager torch.

All roll the same sequence out, features included, with the material graph kept. Training is one sample (one
sub-sequence and one step, forward and backward) out of a batch.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch_geometric.nn import MessagePassing

from benchmarks.harness import Report, interleave, run_alone
from physworld.worldmodel.config import WorldModelConfig
from physworld.worldmodel.engine import RolloutEngine
from physworld.worldmodel.graph import GraphSpec, build_graph
from physworld.worldmodel.model import Normalisation, WorldModel
from physworld.worldmodel.naive import NaiveWorldModel

HIDDEN = (64, 128)
VERTICES, CONTROLS, SPACING_M = 146, 4, 0.01
OUR_FRAMES, PEER_FRAMES, BATCH = 204, 34, 8


class _Interaction(MessagePassing):
    """One message passing step with MLPs of two layers on edges and vertices."""

    def __init__(self, hidden: int, edge_features: int) -> None:
        super().__init__(aggr="mean", node_dim=0)
        self.edge = nn.Sequential(
            nn.Linear(2 * hidden + edge_features, hidden), nn.ReLU(), nn.Linear(hidden, hidden)
        )
        self.vertex = nn.Sequential(nn.Linear(2 * hidden, hidden), nn.ReLU(), nn.Linear(hidden, hidden))

    def forward(self, state: Tensor, edge_index: Tensor, edges: Tensor) -> Tensor:
        """Updated states (V, H)."""
        received = self.propagate(edge_index, x=state, edges=edges)
        return state + self.vertex(torch.cat([state, received], dim=-1))

    def message(self, x_i: Tensor, x_j: Tensor, edges: Tensor) -> Tensor:
        """Messages (E, H)."""
        return self.edge(torch.cat([x_i, x_j, edges], dim=-1))


class _PygNetwork(nn.Module):
    """Encoder, interactions, decoder over the features that ours sees."""

    def __init__(self, naive: NaiveWorldModel) -> None:
        super().__init__()
        model = naive.model
        hidden, h = model.config.hidden, model.config.history
        self.naive = naive
        self.edge_index = torch.stack([naive.sender, naive.receiver])
        inputs = model.skip.in_features
        self.encoder = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden))
        steps = model.config.message_passing_steps
        self.layers = nn.ModuleList(_Interaction(hidden, 3 * h + 8) for _ in range(steps))
        self.decoder = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 3))

    def forward(self, window: Tensor, ahead: Tensor, phi: Tensor) -> Tensor:
        """Outputs (n, 1, 3) for a batch of one."""
        model = self.naive.model
        moves = (window[1:] - window[:-1]).flip(0)
        state = self.encoder(model._vertex_features(window, moves, ahead, phi)[:, 0])
        edges = self.naive.edge_features(window)[:, 0]
        for layer in self.layers:
            state = layer(state, self.edge_index, edges)
        return self.decoder(state[: model.spec.object_count])[:, None]


def measure(repeats: int, seed: int) -> Report:
    """Rollouts and training at both widths."""
    torch.set_num_threads(1)
    speeds: dict[str, dict[str, float]] = {"ours": {}, "pyg": {}, "pytorch_naive": {}}
    training: dict[str, dict[str, float]] = {"ours": {}, "naive": {}}
    rows = []
    spec = None
    for hidden in HIDDEN:
        model, spec = _model(hidden, seed)
        naive = NaiveWorldModel(model)
        start, driven, phi = _sequence(spec, seed)
        cases = {
            "ours": _engine_case(model, start, driven, phi),
            "pyg": _torch_case(model, _PygNetwork(naive), start, driven, phi),
            "pytorch_naive": _torch_case(model, naive, start, driven, phi),
            "train ours": _training_case(model, model, start, driven, phi),
            "train naive": _training_case(model, naive, start, driven, phi),
        }
        for case in cases.values():
            case()
        timings = interleave(cases, repeats)
        for name in speeds:
            speeds[name][str(hidden)] = timings[name].median
        for name in training:
            training[name][str(hidden)] = timings[f"train {name}"].median
        for name, value in timings.items():
            unit = "ms a sample" if name.startswith("train") else "steps/s"
            peer = timings["train naive" if name.startswith("train") else "pyg"].median
            ratio = peer / value.median if name.startswith("train") else value.median / peer
            rows.append(
                [str(hidden), name, f"{value.median:.4g} ± {value.spread:.2g} {unit}", f"{ratio:.2f}"]
            )
    assert spec is not None
    figures = {
        "steps_per_second": speeds,
        "training_ms_per_sample": training,
        "graph": {"vertices": spec.vertex_count, "edges": spec.edge_count},
    }
    return Report(
        name="world_model",
        title="World model: rollout and training, one thread",
        figures=figures,
        header=("hidden", "case", "median", "times the peer"),
        rows=rows,
        notes=(
            f"{spec.vertex_count} vertices, {spec.edge_count} edges, 7 message passing steps, history 3; the graph "
            "is material and kept.",
            "The peer of rollouts is PyG eager, of training our function written the plain way.",
            f"Training: batch {BATCH}, one step forward and backward, per sample; no optimiser.",
        ),
        seed=seed,
    )


def _model(hidden: int, seed: int) -> tuple[WorldModel, GraphSpec]:
    """A bar held at one end, random weights."""
    axes = (np.arange(40), np.arange(8), np.arange(8))
    bar = SPACING_M * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    config = WorldModelConfig(hidden=hidden, vertices=VERTICES, neighbours=7, coarse_vertices=8)
    groups = (np.arange(CONTROLS),)
    spec = build_graph(bar, bar, bar[:CONTROLS], dt_s=1 / 30, config=config, control_groups=groups)
    scales = Normalisation(3e-3, 1e-3, (1e-3,) * 3, (4e-3,) * 3, (4e-3,) * 3, (0.2, 0.1))
    torch.manual_seed(seed)
    return WorldModel(config, spec, scales), spec


def _sequence(spec: GraphSpec, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start (h+1, n, 3), control path (T, C, 3), properties (n, 2)."""
    rng = np.random.default_rng(seed)
    start = spec.rest_vertices + rng.normal(0.0, 1e-3, (4, spec.object_count, 3))
    controls = spec.rest_vertices[spec.neighbours[spec.object_count :, 0]]
    sway = 0.01 * np.sin(0.3 * np.arange(OUR_FRAMES))[:, None, None]
    return start, controls + sway, rng.normal(0.0, 0.1, (spec.object_count, 2))


def _engine_case(
    model: WorldModel, start: np.ndarray, driven: np.ndarray, phi: np.ndarray
) -> Callable[[], float]:
    """Steps per second of the native engine, its preparation included."""

    def run() -> float:
        started = time.perf_counter()
        RolloutEngine(model).run(start, driven, phi)
        return (len(driven) - len(start)) / (time.perf_counter() - started)

    return run


def _torch_case(
    model: WorldModel, network: nn.Module, start: np.ndarray, driven: np.ndarray, phi: np.ndarray
) -> Callable[[], float]:
    """Steps per second of a network stepped by torch."""
    n = model.spec.object_count

    def run() -> float:
        moving, properties = (torch.as_tensor(x, dtype=torch.float32) for x in (driven, phi))
        frames = torch.cat([torch.as_tensor(start, dtype=torch.float32), moving[: len(start)]], dim=1)
        path = list(frames[:, :, None])
        started = time.perf_counter()
        with torch.inference_mode():
            for t in range(len(start), PEER_FRAMES):
                window = torch.stack(path[-len(start) :])
                ahead = torch.cat([2.0 * window[-1, :n] - window[-2, :n], moving[t][:, None]])
                moved = network(window, ahead, properties[:, None])
                path.append(torch.cat([ahead[:n] + 1e-3 * moved, ahead[n:]]))
        return (PEER_FRAMES - len(start)) / (time.perf_counter() - started)

    return run


def _training_case(
    model: WorldModel, network: nn.Module, start: np.ndarray, driven: np.ndarray, phi: np.ndarray
) -> Callable[[], float]:
    """Milliseconds per sample of a forward and a backward pass."""
    whole = np.concatenate([start, driven[: len(start)]], axis=1)
    window = torch.as_tensor(whole, dtype=torch.float32)[:, :, None].repeat(1, 1, BATCH, 1)
    properties = torch.as_tensor(phi, dtype=torch.float32)[:, None].repeat(1, BATCH, 1)

    def run() -> float:
        started = time.perf_counter()
        network.zero_grad(set_to_none=True)
        network(window, window[-1], properties).square().sum().backward()
        return 1e3 * (time.perf_counter() - started) / BATCH

    return run


if __name__ == "__main__":
    run_alone(measure)
