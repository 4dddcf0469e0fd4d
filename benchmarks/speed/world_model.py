"""World model: rollout steps per second, batches, training milliseconds per sample, on one thread; and simulators.

    python -m benchmarks.speed.world_model [--json FILE] [--repeats N] [--seed N]

One graph of 150 vertices and about 1950 directed edges, 7 message passing steps, hidden 64 and 128. Beside ours:

* ``pyg``: the usual interaction network (edge and vertex MLPs of two layers on concatenated states) as a PyTorch
  Geometric ``MessagePassing``, eager, on the same graph and features;
* ``pytorch_naive``: our own function written the plain way (``benchmarks.peers.plain_network``), eager torch.

All roll the same sequence out, features included, with the material graph kept; ``ours_rebuilt`` is ours with its NEAR
edges found anew at every step (``near_edges = "current"``). Training is one sample (one sub-sequence and one step,
forward and backward) out of a batch.

``batch_rollouts_per_second``: candidates of BATCH_STEPS steps from one start, together in the native engine (``ours``,
one thread and as many as there are cores), one call each (``one_by_one``), and together in torch (``torch``, the
network of training).

The simulators simulate the same bar for the same time step of 1/30 s: our own twin (``twin``, total Lagrangian MPM) and
a spring–mass simulator of PhysTwin's size (``benchmarks.peers.spring_mass``). ``times_simulator`` is how many of their
steps one of the model's replaces.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import numpy as np
import torch
import warp as wp
from torch import Tensor, nn
from torch_geometric.nn import MessagePassing

from benchmarks.harness import Report, Timing, interleave, run_alone
from benchmarks.peers.plain_network import PlainNetwork
from benchmarks.peers.spring_mass import SUBSTEPS, SpringMass
from benchmarks.speed.held_bar import held_bar, held_bar_sequence
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.twin.build import build_twin
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.native.engine import RolloutEngine
from physworld.worldmodel.rollout import unroll

HIDDEN = (64, 128)
OUR_FRAMES, PEER_FRAMES, BATCH = 204, 34, 8
CANDIDATES, BATCH_STEPS = 32, 30
BAR_M = np.array([0.4, 0.08, 0.08])
MODULUS_PA, POISSON, DENSITY_KG_M3, PARTICLES = 1e5, 0.35, 1000.0, 2000
TWIN_FRAMES = 10
LABELS = {
    "ours": "rollout: ours",
    "ours_rebuilt": "rollout: ours, near edges of the current shape",
    "pyg": "rollout: PyTorch Geometric, eager",
    "pytorch_naive": "rollout: our function the plain way, eager torch",
    "train ours": "training: ours",
    "train ours_rebuilt": "training: ours, near edges of the current shape",
    "train naive": "training: our function the plain way",
    "batch ours": "batch: ours, one thread",
    "batch ours_all_cores": "batch: ours, all cores",
    "batch one_by_one": "batch: ours, one call each",
    "batch torch": "batch: our network in torch",
    "twin": "simulator: our twin",
    "spring_mass": "simulator: springs",
}
"""What each case is called in the printed table; its figures keep the short names."""


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

    def __init__(self, naive: PlainNetwork) -> None:
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
        state = self.encoder(self.naive.vertex_features(window, ahead, phi)[:, 0])
        edges = self.naive.edge_features(window)[:, 0]
        for layer in self.layers:
            state = layer(state, self.edge_index, edges)
        return self.decoder(state[: model.spec.object_count])[:, None]


def measure(repeats: int, seed: int) -> Report:
    """Rollouts, batches and training at both widths; the simulators once."""
    torch.set_num_threads(1)
    wp.config.quiet = True
    speeds: dict[str, dict[str, float]] = {"ours": {}, "ours_rebuilt": {}, "pyg": {}, "pytorch_naive": {}}
    training: dict[str, dict[str, float]] = {"ours": {}, "ours_rebuilt": {}, "naive": {}}
    batches: dict[str, dict[str, float]] = {}
    rows = []
    spec = None
    for hidden in HIDDEN:
        cases, spec = cases_of(hidden, seed)
        for case in cases.values():
            case()
        timings = interleave(cases, repeats)
        for name in speeds:
            speeds[name][str(hidden)] = timings[name].median
        for name in training:
            training[name][str(hidden)] = timings[f"train {name}"].median
        for name in (name for name in timings if name.startswith("batch ")):
            batches.setdefault(name.removeprefix("batch "), {})[str(hidden)] = timings[name].median
        rows += [_row(str(hidden), name, value, timings) for name, value in timings.items()]
    assert spec is not None
    simulators, simulator_rows = _simulators(speeds["ours"], repeats, seed)
    rows += simulator_rows
    figures = {
        "steps_per_second": speeds,
        "training_ms_per_sample": training,
        "batch_rollouts_per_second": batches,
        "batch": {"candidates": CANDIDATES, "steps": BATCH_STEPS, "threads": _threads()},
        **simulators,
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
            "is material and kept, but for the rows of the current shape, which find their near edges (7 a vertex) at "
            "every step (`near_edges: current`).",
            "The peer of rollouts is PyG eager, of training our function written the plain way.",
            f"Batches: {CANDIDATES} candidates of {BATCH_STEPS} steps from one start; the peer is torch, where the "
            "whole batch is one tensor.",
            f"Simulators: our twin of the same bar (about {PARTICLES} particles, E {MODULUS_PA:.0e} Pa), and springs "
            f"of PhysTwin's size (5,000 points, 66,000 springs, {SUBSTEPS} substeps a frame, no self-collision); "
            "their last column is how many times faster the model of width 64 is.",
            f"Training: batch {BATCH}, one step forward and backward, per sample; no optimiser.",
        ),
        seed=seed,
    )


def cases_of(hidden: int, seed: int) -> tuple[dict[str, Callable[[], float]], GraphSpec]:
    """What is measured of the model at one width, by name, each of ``LABELS``; the graph."""
    model, spec = held_bar(hidden, seed)
    rebuilt, _ = held_bar(hidden, seed, "current")
    naive = PlainNetwork(model)
    start, driven, phi = held_bar_sequence(spec, seed, OUR_FRAMES)
    cases = {
        "ours": _engine_case(model, start, driven, phi),
        "ours_rebuilt": _engine_case(rebuilt, start, driven, phi),
        "pyg": _torch_case(model, _PygNetwork(naive), start, driven, phi),
        "pytorch_naive": _torch_case(model, naive, start, driven, phi),
        "train ours": _training_case(model, model, start, driven, phi),
        "train ours_rebuilt": _training_case(rebuilt, rebuilt, start, driven, phi),
        "train naive": _training_case(model, naive, start, driven, phi),
        **_batch_cases(model, start, driven, phi),
    }
    return cases, spec


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


def _batch_cases(
    model: WorldModel, start: np.ndarray, driven: np.ndarray, phi: np.ndarray
) -> dict[str, Callable[[], float]]:
    """Rollouts per second of candidates that share a start."""
    frames = len(start)
    length = frames + BATCH_STEPS
    tilt = (
        np.linspace(-1.0, 1.0, CANDIDATES)[:, None, None, None]
        * np.linspace(0.0, 0.02, length)[:, None, None]
    )
    candidates = driven[:length][None] + tilt
    engine = RolloutEngine(model)

    def timed(work: Callable[[], object]) -> Callable[[], float]:
        def run() -> float:
            started = time.perf_counter()
            work()
            return CANDIDATES / (time.perf_counter() - started)

        return run

    moving = torch.as_tensor(candidates, dtype=torch.float32).permute(1, 2, 0, 3)
    begin = torch.as_tensor(start, dtype=torch.float32)[:, :, None].expand(-1, -1, CANDIDATES, -1)
    properties = torch.as_tensor(phi, dtype=torch.float32)[:, None].expand(-1, CANDIDATES, -1)
    return {
        "batch ours": timed(lambda: engine.run_batch(start, candidates, phi)),
        "batch ours_all_cores": timed(lambda: engine.run_batch(start, candidates, phi, threads=_threads())),
        "batch one_by_one": timed(lambda: [engine.run(start, path, phi) for path in candidates]),
        "batch torch": timed(lambda: unroll(model, begin, moving, properties)),
    }


def _simulators(
    speeds: dict[str, float], repeats: int, seed: int
) -> tuple[dict[str, object], list[list[str]]]:
    """Steps of 1/30 s per second of our twin and of the springs, and the model's speed over theirs."""
    springs = SpringMass(seed)
    cases = {"twin": _twin_case(), "spring_mass": lambda: _rate(lambda: springs.frame(), 1)}
    for case in cases.values():
        case()
    timings = interleave(cases, repeats)
    figures = {
        "simulator_steps_per_second": {name: value.median for name, value in timings.items()},
        "times_simulator": {
            name: {hidden: speed / value.median for hidden, speed in speeds.items()}
            for name, value in timings.items()
        },
    }
    rows = [
        [
            "",
            LABELS[name],
            f"{value.median:.4g} ± {value.spread:.2g} steps/s",
            f"{speeds['64'] / value.median:.0f}",
        ]
        for name, value in timings.items()
    ]
    return figures, rows


def _twin_case() -> Callable[[], float]:
    """Our own simulation of the bar, held at one end and swayed."""
    times = np.arange(TWIN_FRAMES + 1) / 30.0
    grip = np.array([[0.0, y, z] for y in (0.02, 0.06) for z in (0.02, 0.06)])
    sway = 0.01 * np.sin(9.0 * times)[:, None, None] * np.ones(3)
    scene = Scene(
        name="bar",
        kind="beam",
        points=np.repeat(0.5 * BAR_M[None, None], len(times), axis=0),
        visible=np.ones((len(times), 1), dtype=bool),
        controllers=grip + sway,
        times=times,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=None,
        train=(0, 5),
        test=(5, len(times)),
        initial_state=UNDEFORMED_AT_REST,
        fps=30.0,
        body=Body(size_m=BAR_M, box_min_m=np.zeros(3), box_max_m=BAR_M, density_kg_m3=DENSITY_KG_M3),
        grips=(
            Grip(
                controllers=(0, 1, 2, 3), region_min_m=np.zeros(3), region_max_m=np.array([0.02, *BAR_M[1:]])
            ),
        ),
    )
    twin = build_twin(scene, PARTICLES).with_parameters(youngs_modulus_pa=MODULUS_PA, poissons_ratio=POISSON)
    return lambda: _rate(lambda: twin.simulate_nodes(times, scene.controllers, times), TWIN_FRAMES)


def _rate(work: Callable[[], object], steps: int) -> float:
    started = time.perf_counter()
    work()
    return steps / (time.perf_counter() - started)


def _row(hidden: str, name: str, value: Timing, timings: dict[str, Timing]) -> list[str]:
    """A line of the table: the figure, and how many times its peer it is."""
    kind = name.split()[0]
    unit = {"train": "ms a sample", "batch": "rollouts/s"}.get(kind, "steps/s")
    peer = timings[{"train": "train naive", "batch": "batch torch"}.get(kind, "pyg")].median
    ratio = peer / value.median if kind == "train" else value.median / peer
    return [hidden, LABELS[name], f"{value.median:.4g} ± {value.spread:.2g} {unit}", f"{ratio:.2f}"]


def _threads() -> int:
    return os.cpu_count() or 1


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
