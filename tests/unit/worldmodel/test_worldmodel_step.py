"""The step's contract: every copy of it (ADR 41) gives the same places from the same inputs."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable

import hanging_rope
import held_bar
import numpy as np
import pytest
import torch
from physworld_client.network import Network
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.peers.plain_network import PlainNetwork
from physworld.worldmodel import PublishedModel, affine_skin
from physworld.worldmodel.dataset import read_track
from physworld.worldmodel.export import INPUTS, StepProgram, edge_list
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.features import Normalisation
from physworld.worldmodel.model.frame import enter, leave
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.inertia import InertialPrior
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.modes import ModeScales, measure_modes
from physworld.worldmodel.native.engine import RolloutEngine
from physworld.worldmodel.priors.chain import ChainPhysics, ChainPrior, chain_of
from physworld.worldmodel.priors.chain_layout import arc_lengths, held_vertices, lay_out
from physworld.worldmodel.priors.modal import ModalPrior, fit_prior

pytestmark = pytest.mark.slow

AGREEMENT = 1e-4  # of the network's correction; single precision, over the some hundred substeps of a chain
LEAST_CORRECTION_M = 1e-2
CURRENT = dataclasses.replace(held_bar.SMALL, near_edges="current")
SCALES = dict.fromkeys(("relative", "strain", "stretch"), (0.01, 0.02, 0.03))


@dataclasses.dataclass(frozen=True)
class Inputs:
    """A window (h+1, V, 3), control vertices (C, 3) at t + 1 and Φ (n, 2), float32."""

    window: Tensor
    control_next: Tensor
    phi: Tensor


def bar(
    config: WorldModelConfig,
    ground: float | None,
    *,
    alone: bool = False,
    framed: bool = False,
    line: bool = False,
    modes: bool = False,
) -> tuple[WorldModel, Inputs]:
    spec = held_bar.graph(config, ground, framed=framed)
    if line:  # as for a grip whose points lie on a line
        assert spec.frame is not None
        along = np.outer(np.arange(spec.control_count) - 1.5, [0.0, 0.0, held_bar.SPACING_M])
        spec = dataclasses.replace(
            spec, frame=dataclasses.replace(spec.frame, shape=along, line=np.array([0.0, 0.0, 1.0]))
        )
    tracks = [read_track(spec, held_bar.episode(seed), config.history) for seed in range(4)]
    paths, phis = [t.positions.numpy() for t in tracks], [t.phi.numpy() for t in tracks]
    modal = fit_prior(paths, phis, spec.object_count, config.history, config.modes, spec.frame)
    prior = InertialPrior(spec.object_count) if alone else modal
    given = inputs(spec, config, paths[1], 20)
    if framed:  # a turn that no episode shows
        turn = torch.as_tensor(Rotation.from_rotvec([0.6, -0.9, 0.4]).as_matrix().astype(np.float32))
        given = dataclasses.replace(
            given, window=given.window @ turn.T, control_next=given.control_next @ turn.T
        )
    scales = measure_modes([track.positions for track in tracks], spec, config.history) if modes else None
    return moving(config, spec, prior, scales), given


def rope(markers: int, *, coiled: bool = False, modes: bool = False) -> tuple[WorldModel, Inputs]:
    config, spec = hanging_rope.SMALL, hanging_rope.graph(markers)
    track = read_track(spec, hanging_rope.episode(0, markers=markers), config.history)
    path = track.positions.numpy()
    along = arc_lengths(spec)
    assert along is not None
    layout = lay_out(along, held_vertices(spec, path[::5].astype(float), float(np.ptp(along))), 12)
    physics = ChainPhysics(20.0, 3e-3, 5e-3, 0.1, np.array([0.0, 0.0, -9.81]))
    prior = chain_of(layout, physics, spec.dt_s, np.array([0.6, 0.6]))
    if coiled:
        natural = np.random.default_rng(7).normal(0.0, 8.0, prior.natural.shape).astype(np.float32)
        prior = dataclasses.replace(prior, natural=natural, twist=np.array([0.7], np.float32))
    scales = measure_modes([track.positions], spec, config.history) if modes else None
    return moving(config, spec, prior, scales), inputs(spec, config, path, 6)


def moving(
    config: WorldModelConfig,
    spec: GraphSpec,
    prior: ModalPrior | ChainPrior | InertialPrior,
    modes: ModeScales | None,
) -> WorldModel:
    """An untrained network whose every term moves the body."""
    torch.manual_seed(4)
    scales = Normalisation(velocity=5e-3, change=5e-2, properties=(0.5, 0.3), **SCALES)
    model = WorldModel(config, spec, scales, prior, modes=modes)
    with torch.no_grad():
        if model.modes is not None:
            model.modes.weight.normal_(0.0, 0.1)
        model.skip.weight.normal_(0.0, 0.05)
        model.decoder.out.weight.normal_(0.0, 0.3)
    return model


def inputs(spec: GraphSpec, config: WorldModelConfig, path: np.ndarray, tick: int) -> Inputs:
    n, frames = spec.object_count, config.history + 1
    phi = np.random.default_rng(3).normal(0.0, 0.3, (n, 2)).astype(np.float32)
    places = torch.as_tensor(path[tick : tick + frames + 1])
    return Inputs(places[:frames], places[frames, n:], torch.as_tensor(phi))


def torch_step(model: WorldModel, given: Inputs) -> np.ndarray:
    """The split form: training and fine-tuning."""
    with torch.no_grad():
        moved = model.step(given.window[:, :, None], given.control_next[:, None], given.phi[:, None])
    return moved[:, 0].numpy()


def torch_double(model: WorldModel, given: Inputs) -> np.ndarray:
    """The same without native kernels: other devices, other precision."""
    double = Inputs(given.window.double(), given.control_next.double(), given.phi.double())
    return torch_step(copy.deepcopy(model).double(), double)


def exported(model: WorldModel, given: Inputs) -> np.ndarray:
    """The step that is published as ``step.pt2`` and ``step.onnx``, edge by edge."""
    edges = edge_list(model.spec, given.window[-1].numpy())
    named = vars(given) | {name: torch.as_tensor(value) for name, value in edges.items()}
    with torch.no_grad():
        moved: Tensor = StepProgram(model)(*(named[name] for name in INPUTS))
    return moved.numpy()


def native(model: WorldModel, given: Inputs) -> np.ndarray:
    """Rollouts, planning, live sessions."""
    n = model.spec.object_count
    driven = torch.cat([given.window[:, n:], given.control_next[None]]).numpy()
    return RolloutEngine(model).run(given.window[:, :n].numpy(), driven, given.phi.numpy())[-1]


def client(model: WorldModel, given: Inputs) -> np.ndarray:
    """The SDK without torch, from a version's tensors."""
    spec = model.spec
    n, frames = spec.object_count, len(given.window)
    tensors = PublishedModel(
        model=model,
        phi=given.phi.numpy(),
        phi_calibrated=np.zeros((n, 2)),
        start_history=given.window[:, :n].numpy(),
        start_controllers=np.zeros((frames, spec.control_count, 3)),
        start_time_s=0.0,
        skin=affine_skin(spec.rest_vertices[:3], spec.rest_vertices),
    ).to_tensors()
    double = (part.double().numpy() for part in (given.window, given.control_next))
    return Network(tensors, n).step(*double, given.phi.numpy())


def plain_peer(model: WorldModel, given: Inputs) -> np.ndarray:
    """The oracle: nothing taken apart."""
    n, frame = model.spec.object_count, model.spec.frame
    window, control, phi = given.window[:, :, None], given.control_next[:, None], given.phi[:, None]
    turn = None
    if frame is not None:
        turn, window, control = enter(frame, window, control)
    with torch.no_grad():
        ahead = torch.cat([model.prior(window, control, phi), control])
        ahead[:n] += model.norm.change * PlainNetwork(model)(window, ahead, phi)
    if frame is not None and turn is not None:
        ahead = torch.cat([leave(frame, turn, ahead[:n]), given.control_next[:, None]])
    return ahead[:, 0].numpy()


COPIES: tuple[Callable[[WorldModel, Inputs], np.ndarray], ...] = (
    torch_step, torch_double, exported, native, client, plain_peer,
)  # fmt: skip
BODIES: dict[str, Callable[[], tuple[WorldModel, Inputs]]] = {
    "modal prior": lambda: bar(held_bar.SMALL, None),
    "modal prior over a ground": lambda: bar(held_bar.SMALL, -0.1),
    "edges of the current shape": lambda: bar(CURRENT, None),
    "modal prior in the grip's frame": lambda: bar(held_bar.SMALL, None, framed=True),
    "no prior in the grip's frame": lambda: bar(held_bar.SMALL, None, alone=True, framed=True),
    "no prior and a map of modes": lambda: bar(held_bar.SMALL, None, alone=True, modes=True),
    "no prior and a map of modes over a ground": lambda: bar(held_bar.SMALL, -0.1, alone=True, modes=True),
    "no prior and a map of modes in the grip's frame": lambda: bar(
        held_bar.SMALL, None, alone=True, framed=True, modes=True
    ),
    "grip's frame of points on a line": lambda: bar(held_bar.SMALL, None, framed=True, line=True),
    "no prior": lambda: bar(held_bar.SMALL, None, alone=True),
    "chain prior, grips of two markers": lambda: rope(2),
    "chain prior, grips of three markers": lambda: rope(3),
    "chain prior and a map of modes": lambda: rope(3, modes=True),
    "coiled chain and a map of modes": lambda: rope(2, coiled=True, modes=True),
    "coiled chain between two grips": lambda: rope(2, coiled=True),
    "coiled chain on one grip": lambda: rope(3, coiled=True),
}


@pytest.mark.parametrize("body", BODIES)
def test_every_copy_of_the_step_is_the_same_function(body: str) -> None:
    model, given = BODIES[body]()
    n = model.spec.object_count
    moved = {one.__name__: one(model, given) for one in COPIES}
    expected = moved["torch_double"]
    with torch.no_grad():
        ahead = model.prior_ahead(given.window[:, :, None], given.control_next[:, None], given.phi[:, None])[
            :, 0
        ]
    correction = float(np.abs(expected[:n] - ahead.numpy()).max())
    assert correction > LEAST_CORRECTION_M, "a network that adds nothing shows nothing"
    for name, places in moved.items():
        assert places.shape == expected.shape, name
        assert np.abs(places - expected).max() < AGREEMENT * correction, name
